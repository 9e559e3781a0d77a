from __future__ import annotations

import json
import math
import re

import pytest

from impslam.cli.demo_arena import degrees
from impslam.cli.run_folder import RUN_FILES


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory):
    return tmp_path_factory.mktemp("demo") / "run"


def test_the_arena_is_mapped_within_centimetres(imp, demo) -> None:
    said = imp("demo", "-o", demo)
    assert said.code == 0, said.err
    for name in ("wall 1", "wall 2", "wall 3", "wall 4"):
        assert error(said.out, name) < 2.0
    for name in ("cylinder 1", "cylinder 2", "cylinder 3"):
        assert error(said.out, name) < 3.0
    assert float(re.search(r"estimated .* ([\d.]+) cm", said.out)[1]) < 3.0
    assert "not in the arena: cylinder" not in said.out
    assert "not in the arena: wall" not in said.out
    log = {"arena.mcap", "arena.truth.tum", "arena.landmarks.csv"}
    assert {path.name for path in demo.iterdir()} == RUN_FILES - {"graph.g2o"} | log
    assert json.loads((demo / "summary.json").read_text())["log"]["path"] == "arena.mcap"
    said = imp("demo", "-o", demo, "--quiet")
    assert (said.code, said.err.count("\n")) == (2, 1)
    assert "contains a run" in said.err


def error(text: str, name: str) -> float:
    """Return the error in a landmark's row, in cm."""
    words = next(line for line in text.splitlines() if name in line).split()
    return float(words[-2] if name.startswith("wall") else words[-1])


def test_degrees_have_no_negative_zero_and_one_sign_for_a_half_turn() -> None:
    assert f"{degrees(-1e-6):z.2f}" == "0.00"
    assert degrees(-math.pi + 1e-6) == degrees(math.pi) == 180.0
    assert degrees(math.radians(179.97)) == 179.97
