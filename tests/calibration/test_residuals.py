"""Residuals of lidar motions: zero for the true parameters, and their derivatives."""

import numpy as np
import pytest
from tests.calibration.drives import SCALES, TRUE, drive, twists, wheels
from tests.numeric import jacobian

from impslam.calibration.odometry_models import WINDOW
from impslam.calibration.residuals import residuals

WHEELS, TWISTS = drive(wheels(20.0)[0]), drive(twists(20.0), true=SCALES)


@pytest.mark.parametrize(("of", "true"), [(WHEELS, TRUE), (TWISTS, SCALES)])
def test_residuals_are_zero_for_the_true_parameters(of, true):
    np.testing.assert_allclose(residuals(of, true).values, 0.0, atol=1e-9)


@pytest.mark.parametrize(("of", "true"), [(WHEELS, TRUE), (TWISTS, SCALES)])
def test_jacobian(of, true):
    at = true + np.array([0.001, 0.01, 0.01, 0.05, 0.04, -0.3, 0.011, 0.02, 0.05])
    exact = residuals(of, at).by_all.reshape(-1, 9)

    def values(parameters):
        return residuals(of, parameters).values.ravel()

    others = np.arange(9) != 6  # the latency's is a mean over a window
    np.testing.assert_allclose(exact[:, others], jacobian(values, at, 1e-6)[:, others], atol=1e-6)
    np.testing.assert_allclose(exact[:, 6], jacobian(values, at, WINDOW)[:, 6], atol=5e-3)
