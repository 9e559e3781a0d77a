"""The recording for Rerun; what is written is tested where the viewer's library is installed."""

import sys

import pytest
from tests.observers import runs

from impslam.errors import ConfigError
from impslam.observers.rerun_file import RerunFile


def test_without_the_library_the_error_gives_the_install_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"pip install .*(rerun-sdk|view)"):
        RerunFile(tmp_path / "run.rrd")


def test_the_recording_contains_the_robot_at_each_scan(tmp_path):
    pytest.importorskip("rerun")
    read = pytest.importorskip("rerun.chunk").RrdReader
    file = RerunFile(tmp_path / "run.rrd")
    for pose in runs.make_truth():
        file.truth(pose)
    runs.play([file])
    entities, rows = set(), 0
    for chunk in read(str(tmp_path / "run.rrd")).stream():
        entities.add(str(chunk.entity_path).strip("/"))
        if str(chunk.entity_path).endswith("robot") and not chunk.is_static:
            rows += chunk.num_rows
    drawn = {
        f"map/{name}" for name in ("grid", "path", "walls", "points", "truth", "robot", "scan")
    }
    assert drawn | {"health"} <= entities
    assert rows == 50
