"""Files that commands write: whole, or as they were before."""

from __future__ import annotations

import errno
import json
import os

import pytest

from impslam.cli.output_files import write_json
from impslam.errors import ImpError


def test_unknown_numbers_are_null(tmp_path) -> None:
    file = tmp_path / "facts.json"
    write_json(file, {"length": float("nan"), "unit": "µm"})
    assert json.loads(file.read_text("utf-8")) == {"length": None, "unit": "µm"}


def test_a_full_disk_leaves_the_earlier_file(tmp_path, monkeypatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    file = tmp_path / "facts.json"
    write_json(file, {"scans": 1})
    before = file.read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ImpError, match=r"facts\.json: cannot be written \(No space.*another path"):
        write_json(file, {"scans": 2})
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]
