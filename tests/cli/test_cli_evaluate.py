from __future__ import annotations

import numpy as np
import pytest

from impslam.evaluation.trajectory import move
from impslam.evaluation.tum import write_tum


def path(tmp_path, name, shift=(0.0, 0.0, 0.0)):
    t = np.arange(50.0)
    poses = move(np.array(shift), np.column_stack((0.1 * t, np.sin(0.1 * t), 0.1 * t)))
    write_tum(tmp_path / name, np.column_stack((t, poses)))
    return tmp_path / name


def row(text: str, name: object) -> list[str]:
    """Return the figures in a run's row; long names are folded, so by their first word's line."""
    line = next(line for line in text.splitlines() if line.strip().startswith(str(name)[:20]))
    return line.split()[1:]


def test_against_truth(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path(tmp_path, "truth.tum")
    path(tmp_path, "same.tum")
    path(tmp_path, "off.tum", (0.3, 0.4, 0.0))
    said = imp("evaluate", "same.tum", "off.tum", "--truth", "truth.tum")
    assert said.code == 0, said.err
    assert row(said.out, "same.tum")[:4] == ["50", "0.0000", "0.0000", "0.0000"]
    assert row(said.out, "off.tum")[:4] == ["50", "0.5000", "0.0000", "0.0000"]


def test_against_relations(imp, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path(tmp_path, "line.tum")
    (tmp_path / "some.relations").write_text("0 0 0.03 0.04 0 0 0 0\n0 99 1 1 0 0 0 0\n")
    said = imp("evaluate", "line.tum", "--relations", "some.relations")
    assert said.code == 0, said.err
    figures = " ".join(row(said.out, "line.tum"))
    assert figures == "1 1 0.050 ± 0.000 0.050 0.00 ± 0.00 0.00"


def test_a_run_folder(imp, tmp_path) -> None:
    truth = path(tmp_path, "trajectory.tum")
    assert imp("evaluate", tmp_path, "--truth", truth).code == 0


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--truth", "x"], "no run given"),
        (["x.tum", "--truth", "none.tum"], "none.tum"),
        (["none.tum"], "none.tum: no such run"),
        (["."], "no trajectory.tum"),
    ],
)
def test_one_line_errors(imp, tmp_path, monkeypatch, words, part) -> None:
    monkeypatch.chdir(tmp_path)
    said = imp("evaluate", *words)
    assert said.code == 2
    assert part in said.err
    assert said.err.count("\n") == 1
