"""`imp run` writes files for other programs."""

import json

import cv2
import pytest
from rosbags.highlevel import AnyReader

from impslam.errors import ImpError
from impslam.observers import ros_map, video


def test_exports_are_written_and_listed(imp, room, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "SIZE", 200)
    monkeypatch.setattr(video, "RATE", 2.0)
    mcap, mp4 = tmp_path / "run.mcap", tmp_path / "run.mp4"
    done = imp("run", room, "-o", tmp_path / "run", "--mcap", mcap, "--video", mp4)
    assert (done.code, done.err) == (0, "")
    assert f"for Foxglove and RViz: {mcap}" in done.out
    assert f"video: {mp4}" in done.out
    scans = json.loads((tmp_path / "run" / "summary.json").read_text())["counts"]["steps"]
    with AnyReader([mcap]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections}["/tf"] == scans
    assert cv2.VideoCapture(str(mp4)).get(cv2.CAP_PROP_FRAME_COUNT) > 10


@pytest.mark.parametrize(
    ("option", "name", "said"),
    [
        ("--mcap", "run.bag", "end in .mcap"),
        ("--video", "run.avi", "end in .mp4"),
        ("--rerun", "run.rerun", "end in .rrd"),
        ("--mcap", "nowhere/run.mcap", "no such folder"),
        ("--mcap", "/proc/run.mcap", "/proc/run.mcap: cannot be written ("),
        ("--video", "a.mp4", "a.mp4: is a folder"),
    ],
)
def test_an_unusable_export_path_is_rejected_before_the_run(
    imp, brief, tmp_path, option, name, said
):
    (tmp_path / "a.mp4").mkdir()
    done = imp("run", brief, "-o", tmp_path / "run", option, tmp_path / name)
    assert done.code == 2
    assert said in done.err
    assert done.out == ""  # and before the log is diagnosed
    assert not (tmp_path / "run").exists()


def test_a_failed_export_leaves_a_complete_map(imp, brief, tmp_path, monkeypatch):
    def full(*_):
        raise ImpError("run.mcap: cannot be written (No space left on device)")

    monkeypatch.setattr(ros_map, "write_ros_map", full)
    done = imp("run", brief, "-o", tmp_path / "run", "--mcap", tmp_path / "run.mcap")
    assert done.code == 2
    assert done.err.endswith(
        f"(No space left on device); {tmp_path / 'run'} contains the complete map\n"
    )
    assert not json.loads((tmp_path / "run" / "summary.json").read_text())["partial"]
