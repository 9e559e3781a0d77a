"""What the demo knows of the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tests.observers import runs

from impslam.observers.ending import EndOfRun
from impslam.types import TruePose


def test_truth_at_the_last_scan() -> None:
    end = EndOfRun()
    assert end.true is None
    assert end.pose is None
    truth = [*runs.make_truth(), TruePose(1300000099.0, np.zeros(3))]
    known = runs.play([end], truth=truth)
    np.testing.assert_array_equal(end.true, truth[-2].pose)
    np.testing.assert_array_equal(end.pose, known.path()[-1, 1:])
    np.testing.assert_array_equal(end.odometry, known.odometry()[-1, 1:])


def test_poses_are_those_of_the_last_placed_sweep() -> None:
    end, truth = EndOfRun(), [*runs.make_truth()]
    known = runs.play([end], truth=truth)
    placed = np.arange(len(known.keyframes)) < 30
    end.known = replace(known, keyframes=replace(known.keyframes, placed=placed))
    last = int(np.flatnonzero(end.known.placed())[-1])
    assert last < len(known.stamps) - 1
    np.testing.assert_array_equal(end.pose, known.path()[last, 1:])
    np.testing.assert_array_equal(end.odometry, known.odometry()[last, 1:])
    np.testing.assert_array_equal(end.true, truth[last].pose)
