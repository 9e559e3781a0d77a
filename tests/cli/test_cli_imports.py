"""What a command does not need is not imported: start-up is most of a short run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from impslam.cli.commands import COMMANDS
from impslam.cli.map import COMMANDS as MAP_COMMANDS

CODE = (
    "import json, sys; from impslam.cli import main; code = main(sys.argv[1:]);"
    "sys.stderr.write(json.dumps([code, list(sys.modules)]))"
)
SLOW = {"numpy", "numba", "scipy", "cv2", "matplotlib", "rosbags"}
NOT_TO_MAP = {"matplotlib", "rosbags", "rich", "scipy.linalg", "scipy.optimize", "scipy.special"}
"""What no run of a text log has to do with."""


def imported(*words: object) -> set[str]:
    """Return the modules that a command has imported when it is done."""
    said = subprocess.run(
        [sys.executable, "-c", CODE, *map(str, words)], capture_output=True, text=True, check=True
    )
    code, modules = json.loads(said.stderr.splitlines()[-1])
    assert code == 0
    return set(modules)


@pytest.mark.parametrize("command", ["", *COMMANDS, *(f"map {name}" for name in MAP_COMMANDS)])
def test_help_imports_nothing_slow(command: str) -> None:
    assert imported(*command.split(), "--help") & SLOW == set()


def carmen(path: Path) -> Path:
    """Write a log of a robot that stands in the corner of a room."""
    ranges = " ".join(["2.00"] * 60 + ["3.00"] * 60 + ["2.00"] * 60)
    tail = "0.0 0.0 0.0 {0} host {0}\n"
    lines = []
    for i in range(10):
        lines.append("ODOM 0.0 0.0 0.0 0.0 0.0 0.0 {0} host {0}\n".format(0.1 * i))
        lines.append(f"FLASER 180 {ranges} 0.0 0.0 0.0 " + tail.format(0.1 * i + 0.05))
    path.write_text("".join(lines))
    return path


def test_mapping_a_text_log_imports_little(tmp_path: Path) -> None:
    log = carmen(tmp_path / "room.log")
    imported("run", log, "-o", tmp_path / "first", "--quiet")  # which compiles what it needs
    modules = imported("run", log, "-o", tmp_path / "second", "--quiet")
    assert modules & NOT_TO_MAP == set()
    assert not any(m.startswith("numba.np.arraymath") for m in modules)  # machine code needs none
    readers = {m for m in modules if m.startswith("impslam.sources.")}
    assert "impslam.sources.rosbag" not in readers
    assert "impslam.sources.mrclam" not in readers
    assert "impslam.tracking.scan_to_map" in modules
    assert "impslam.association.jcbb" not in modules
    assert "impslam.estimators.graph" in modules
    assert "impslam.estimators.particles" not in modules


OF_EXTRAS = {
    "arro3", "cobs", "cryptography", "distributed", "fastapi", "gtsam", "h11", "ifaddr", "nicegui",
    "optuna", "pynmeagps", "rerun", "serial", "starlette", "uvicorn",
}  # fmt: skip
"""What `pip install impslam` does not install."""
WITHOUT_EXTRAS = f"import sys; sys.modules.update(dict.fromkeys({sorted(OF_EXTRAS)}));" + CODE


@pytest.mark.parametrize(
    "words",
    [("run", "room.log", "-o", "run"), ("inspect", "room.log"), ("config",), ("list",)],
    ids=" ".join,
)
def test_it_works_without_the_extras(words: tuple[str, ...], tmp_path: Path) -> None:
    carmen(tmp_path / "room.log")
    said = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS, *words],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    code, modules = json.loads(said.stderr.splitlines()[-1])
    assert code == 0
    beside = {m for m in modules if m.startswith(("impslam.platform.", "impslam.studies."))}
    devices = {m for m in beside if m.startswith("impslam.platform.devices")}
    assert beside == (devices if words == ("list",) else set())
