"""A run that closes a loop: what it tells of it, and what must not jump."""

from pathlib import Path

import numpy as np
import pytest
from tests.rings import GRAPH, ring

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose
from impslam.map import Map, T_map_odom
from impslam.observers.base import Observer
from impslam.run import Run


class Seen(Observer):
    """The keyframes at which a loop closed, and frames and poses at each scan."""

    def __init__(self):
        self.loops, self.frames = [], []

    def watch(self, run):
        self.run = run

    def follow(self, track, path):
        for pose, odometry in zip(path.poses, path.odometry, strict=True):
            self.frames.append((T_map_odom(pose, odometry), odometry, pose))

    def revise(self, keyframe, revision, path):
        self.follow(None, path)
        np.testing.assert_array_equal(self.run.T_map_odom, self.frames[-1][0])
        np.testing.assert_array_equal(self.run.odometry, self.frames[-1][1])
        if len(revision.ids) > 1:
            self.loops.append(keyframe.id)


@pytest.fixture(scope="module")
def messages():
    return list(ring())


@pytest.fixture(scope="module")
def driven(messages):
    """The run, its map, and what an observer saw."""
    seen = Seen()
    run = Run(GRAPH, [seen])
    seen.watch(run)
    return run, run.play(messages), seen


def test_the_map_has_the_graph(driven, tmp_path):
    _, known, seen = driven
    edges = known.edges
    closures = np.isfinite(edges.kernel)
    assert seen.loops
    assert closures.any()
    assert (edges.i[~closures] == np.r_[0, edges.j[~closures][:-1]]).all()  # the chain has no gap
    assert (np.abs(edges.j - edges.i)[closures] > 50).all()  # a lap has about 100 keyframes
    poses = known.keyframes.poses
    error = between(poses[edges.i], poses[edges.j]) - edges.T_i_j
    assert np.abs(error[:, :2]).max() < 0.1
    assert (np.linalg.eigvalsh(edges.information) > 0.0).all()
    back = Map.load(known.save(tmp_path / "ring.imp")).edges
    assert [a.tobytes() for a in back] == [np.ascontiguousarray(a).tobytes() for a in edges]


def test_odometry_does_not_jump_where_a_loop_closes(driven):
    run, known, seen = driven
    frames, odometry, poses = (np.array(column) for column in zip(*seen.frames, strict=True))
    np.testing.assert_allclose(compose(frames, odometry)[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(compose(frames, odometry)[:, 2] - poses[:, 2]), 0, atol=1e-9)
    steps = {
        name: np.hypot(*np.diff(path[:, :2], axis=0).T)
        for name, path in (("odom", odometry), ("map", poses))
    }
    assert steps["odom"].max() < 0.3  # 1 m/s at 5 Hz
    assert steps["map"].max() > 1.0
    at = int(np.argmax(steps["map"]))
    assert np.abs(frames[at + 1] - frames[at])[:2].max() > 0.5
    np.testing.assert_array_equal(run.odometry, odometry[-1])
    np.testing.assert_allclose(compose(run.T_map_odom, run.odometry), known.path()[-1, 1:])


def test_odom_is_map_before_the_first_scan():
    run = Run(GRAPH)
    assert run.T_map_odom.tolist() == run.odometry.tolist() == [0.0, 0.0, 0.0]


def test_the_outcome_counts_loops_and_times_the_refinement(driven):
    run, _, _ = driven
    known = run.refined()
    outcome = run.outcome(Path("ring"), "", len(known.landmarks))
    closures = int(np.isfinite(known.edges.kernel).sum())
    assert outcome.counts["loops closed"] == closures
    assert outcome.counts["loops tried"] >= closures
    assert outcome.counts["landmarks"] == len(known.landmarks)
    assert len(outcome.stages["refine"]) == 1
    assert not outcome.lidar_alone
