"""The end of runs that went wrong: not located in the map, or ended by an error of a part."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import impslam
from impslam.config import load
from impslam.continuing import KnownMap
from impslam.errors import ImpError
from impslam.estimators.graph import Graph
from impslam.observers.base import Observer
from impslam.observers.live_view import LiveView
from impslam.observers.recorder import Recorder
from impslam.observers.ros_map import RosMap
from impslam.observers.video import Video
from impslam.run import Run
from impslam.types import LaserScan, OdometryPose

CONFIG = load("default", ["tracker.kind=scan_to_map", "estimator.kind=graph"])
ANGLES = np.radians(np.arange(-180.0, 180.0))


def turning(scans, side=2.0):
    """Yield the messages of a robot that turns on the spot in a square room, `side` m from its walls."""
    rng = np.random.default_rng(0)
    for k in range(scans):
        facing = ANGLES + 0.05 * k
        ranges = side / np.maximum(abs(np.cos(facing)), abs(np.sin(facing)))
        yield OdometryPose(0.1 * k, np.array([0.0, 0.0, 0.05 * k]))
        noise = rng.normal(0.0, 0.01, len(ANGLES))
        yield LaserScan(0.1 * k, ANGLES, ranges + noise, np.zeros(len(ANGLES)), 0.1, 20.0)


class Failing(Observer):
    """Fails at the end of the run."""

    def finish(self, known, outcome):
        raise ImpError("no space left")


def test_slam_finishes_all_observers_even_if_one_fails(tmp_path):
    slam = impslam.Slam(CONFIG, observers=[Failing(), Recorder(tmp_path / "run"), Failing()])
    headings = 0.05 * np.arange(30)
    facing = ANGLES + headings[:, None]
    ranges = 2.0 / np.maximum(abs(np.cos(facing)), abs(np.sin(facing)))
    slam.add_odometry(0.1 * np.arange(30), np.column_stack([np.zeros((30, 2)), headings]))
    slam.add_scans(0.1 * np.arange(30), ranges, ANGLES, range_max=10.0)
    with pytest.raises(ImpError, match="no space left") as raised:
        slam.finish()
    assert raised.value.__notes__ == ["no space left"]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["partial"] is None
    assert summary["counts"]["steps"] == 30


@pytest.mark.parametrize(("kind", "name"), [(Video, "run.mp4"), (RosMap, "run.mcap")])
def test_a_run_that_is_not_located_has_no_video_and_no_ros_map(tmp_path, kind, name):
    mapped = Run(CONFIG)
    mapped.play(turning(60))
    lost = Run(CONFIG, [], KnownMap(mapped.refined(), frozen=True))
    lost.play(turning(30, side=7.0))
    known = lost.refined()
    assert not known.placed().any()
    with pytest.raises(ImpError, match=f"{name}: not written, because no scan is located"):
        kind(tmp_path / name).finish(known, lost.outcome(Path("log"), "", 0))
    assert not (tmp_path / name).exists()


def test_the_last_snapshot_of_a_lost_robot_shows_no_path(monkeypatch):
    """The pose in a session that is not located says nothing about the map."""
    add = Graph.add
    monkeypatch.setattr(
        Graph, "add", lambda self, frame: add(self, replace(frame, lost=frame.id == 10))
    )
    view = LiveView()
    run = Run(CONFIG, [view])
    view.begin(run)
    run.play(turning(150))
    before = view.snapshot()
    assert not before.placed
    known = run.refined()
    assert known.placed().any()
    view.finish(known, run.outcome(Path("log"), "", 0))
    after = view.snapshot()
    assert not after.placed
    assert len(after.path) == 0
    np.testing.assert_array_equal(after.pose, before.pose)


def test_a_draft_after_an_error_of_the_estimator_is_the_map_before_it(monkeypatch):
    """Its keyframe is in the estimator, but not in the map."""

    def failing(self):
        raise np.linalg.LinAlgError("Singular matrix")

    run = Run(CONFIG)
    run.play(turning(60))
    before = run.draft(Path("log"))()[0]
    monkeypatch.setattr(Graph, "_add_node_if_due", failing)
    with pytest.raises(np.linalg.LinAlgError):
        run.play(turning(200))
    after, _ = run.draft(Path("log"))()
    assert len(run.estimator.observations()) == len(after.keyframes) + 1
    assert len(after.observations) == len(after.keyframes) == len(before.keyframes) > 0
    np.testing.assert_allclose(after.keyframes.poses, before.keyframes.poses, atol=0.05)
