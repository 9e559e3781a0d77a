"""What the demo knows of the truth."""

from __future__ import annotations

import numpy as np

from impslam.cli.ending import EndOfRun
from impslam.types import StepResult, TruePose


def test_truth_at_the_last_scan() -> None:
    end = EndOfRun()
    assert end.true is None
    for stamp in (1.0, 1.1, 1.2):
        end.truth(TruePose(stamp, np.full(3, stamp)))
    end.step(StepResult(1.1, np.ones(3), np.eye(3), np.zeros(3), np.ones(3), None, (), (), (), ()))
    np.testing.assert_array_equal(end.true, np.full(3, 1.1))
    np.testing.assert_array_equal(end.pose, np.ones(3))
