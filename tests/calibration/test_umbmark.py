"""UMBmark: squares driven with known wheel errors give these errors, to first order."""

import numpy as np
import pytest

from impslam.calibration.odometry_models import DifferentialDrive, motion
from impslam.calibration.umbmark import corrected, umbmark

SIDE, NOMINAL = 2.0, np.array([0.05, 1.0, 0.3])


def square(true, sign):
    """Return the return error of a square driven by nominal wheels, true minus odometry."""
    wheel = SIDE / NOMINAL[0]
    corner = 0.25 * np.pi * NOMINAL[2] / NOMINAL[0]
    left = np.tile(np.repeat([wheel / 100, -sign * corner / 100], 100), 4)
    right = np.tile(np.repeat([wheel / 100, sign * corner / 100], 100), 4)
    stamps = np.arange(len(left) + 1.0)
    model = DifferentialDrive(stamps, np.zeros(len(left), bool), left, right)
    ends = [
        motion(model, values, 0.0, stamps[:1], stamps[-1:]).translation[0]
        for values in (true, NOMINAL)
    ]
    off = ends[0] - ends[1]
    return np.array([[off.real, off.imag]])


@pytest.mark.parametrize(("ratio", "track"), [(1.002, 0.3), (1.0, 0.302), (0.998, 0.297)])
def test_wheels_are_found(ratio, track):
    """UMBmark does not determine the mean diameter and assumes it is correct."""
    true = np.array([2.0 * NOMINAL[0] / (1.0 + ratio), ratio, track])
    found = umbmark(square(true, -1), square(true, 1), SIDE, NOMINAL[2])
    new = corrected(found, NOMINAL)
    np.testing.assert_allclose(new[1:], true[1:], rtol=5e-4)
    before = found.error
    errors = [square(true, s) for s in (-1, 1)]
    assert before == pytest.approx(max(np.hypot(*e[0]) for e in errors))


def test_mean_diameter_stays():
    found = umbmark(np.array([[-0.03, 0.01]]), np.array([[0.02, 0.0]]), SIDE, 0.3)
    new = corrected(found, NOMINAL)
    assert new[0] * (1.0 + new[1]) == pytest.approx(2.0 * NOMINAL[0])
