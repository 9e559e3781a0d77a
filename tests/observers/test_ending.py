"""What the demo knows of the truth."""

from __future__ import annotations

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
