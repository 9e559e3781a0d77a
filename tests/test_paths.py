from __future__ import annotations

from pathlib import Path

import pytest

from impslam.paths import unused


@pytest.mark.parametrize(
    ("there", "suffix", "name"),
    [
        ([], ".mcap", "exp.1.mcap"),
        (["exp.1"], ".mcap", "exp.1.mcap"),
        (["exp.1.mcap"], ".mcap", "exp.1-2.mcap"),
        (["exp.1", "exp.1-2"], "", "exp.1-3"),
        (["exp.1", "exp.1-3"], "", "exp.1-2"),
    ],
)
def test_a_name_that_is_taken_gets_a_number(
    tmp_path: Path, there: list[str], suffix: str, name: str
) -> None:
    for taken in there:
        (tmp_path / taken).mkdir()
    assert unused(tmp_path, "exp.1", suffix) == tmp_path / name
