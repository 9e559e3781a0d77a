"""What a command does not need is not imported: start-up is most of a short run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from impslam.cli.commands import COMMANDS
from impslam.cli.map import COMMANDS as MAP_COMMANDS

CODE = """
import json, sys
from impslam.cli import main
for words in json.loads(sys.argv[1]):
    code = main(words)
    sys.stderr.write(json.dumps([code, list(sys.modules)]) + "\\n")
"""
SLOW = {"numpy", "numba", "scipy", "cv2", "matplotlib", "rosbags"}
NOT_TO_MAP = {"matplotlib", "rosbags", "rich", "scipy.linalg", "scipy.optimize", "scipy.special"}
"""What no run of a text log has to do with."""


def imported(*commands: list[str], before: str = "", cwd: Path | None = None) -> list[set[str]]:
    """Return the modules that are imported after each of several commands in one process."""
    said = subprocess.run(
        [sys.executable, "-c", before + CODE, json.dumps(commands)],
        capture_output=True, text=True, check=True, cwd=cwd,
    )  # fmt: skip
    ended = [json.loads(line) for line in said.stderr.splitlines() if line.startswith("[")]
    assert [code for code, _ in ended] == [0] * len(commands), said.stderr
    return [set(modules) for _, modules in ended]


def test_help_imports_nothing_slow() -> None:
    commands = ["", *COMMANDS, *(f"map {name}" for name in MAP_COMMANDS)]
    seen = imported(*([*command.split(), "--help"] for command in commands))
    assert [c for c, modules in zip(commands, seen, strict=True) if modules & SLOW] == []


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


OF_EXTRAS = {
    "arro3", "cobs", "cryptography", "distributed", "fastapi", "gtsam", "h11", "ifaddr", "nicegui",
    "optuna", "pynmeagps", "rerun", "serial", "starlette", "uvicorn",
}  # fmt: skip
"""What `pip install impslam` does not install."""
WITHOUT_EXTRAS = f"import sys; sys.modules.update(dict.fromkeys({sorted(OF_EXTRAS)}));"


@pytest.fixture(scope="module")
def without_extras(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """The modules after each of several commands, which compile what mapping a text log needs."""
    folder = tmp_path_factory.mktemp("log")
    carmen(folder / "room.log")
    commands = "run room.log -o run --quiet", "inspect room.log", "config", "list"
    seen = imported(*map(str.split, commands), before=WITHOUT_EXTRAS, cwd=folder)
    return {command.split()[0]: modules for command, modules in zip(commands, seen, strict=True)}


def test_it_works_without_the_extras(without_extras: dict[str, set[str]]) -> None:
    for command, modules in without_extras.items():
        beside = {m for m in modules if m.startswith(("impslam.platform.", "impslam.studies."))}
        devices = {m for m in beside if m.startswith("impslam.platform.devices")}
        assert beside == (devices if command == "list" else set()), command


def test_mapping_a_text_log_imports_little(tmp_path: Path, without_extras: object) -> None:
    log, folder = carmen(tmp_path / "room.log"), tmp_path / "run"
    (modules,) = imported(["run", str(log), "-o", str(folder), "--quiet"])
    assert modules & NOT_TO_MAP == set()
    assert not any(m.startswith("numba.np.arraymath") for m in modules)  # machine code needs none
    readers = {m for m in modules if m.startswith("impslam.sources.")}
    assert "impslam.sources.rosbag" not in readers
    assert "impslam.sources.mrclam" not in readers
    assert "impslam.tracking.scan_to_map" in modules
    assert "impslam.association.jcbb" not in modules
    assert "impslam.estimators.graph" in modules
    assert "impslam.estimators.particles" not in modules
