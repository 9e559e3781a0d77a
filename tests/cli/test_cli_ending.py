"""What the demo knows of the truth."""

from __future__ import annotations

import numpy as np

from impslam.cli.ending import EndOfRun, corners
from impslam.simulation.world import load_world
from impslam.types import StepResult, TruePose


def test_corners_of_a_room() -> None:
    places = {tuple(corner.position) for corner in corners(load_world("room").landmarks())}
    assert places == {(-0.6, -0.8), (2.4, -0.8), (2.4, 1.8), (-0.6, 1.8)}


def test_truth_at_the_last_scan() -> None:
    end = EndOfRun()
    assert end.true is None
    for stamp in (1.0, 1.1, 1.2):
        end.truth(TruePose(stamp, np.full(3, stamp)))
    end.step(StepResult(1.1, np.ones(3), np.eye(3), np.zeros(3), np.ones(3), None, (), (), (), ()))
    np.testing.assert_array_equal(end.true, np.full(3, 1.1))
    np.testing.assert_array_equal(end.pose, np.ones(3))
