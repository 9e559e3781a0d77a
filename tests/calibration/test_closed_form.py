"""Initial estimate: exact without noise, except for the latency, which is searched on a grid."""

import numpy as np
import pytest
from tests.calibration.drives import SCALES, TRUE, drive, none, twists, wheels

from impslam.calibration.closed_form import initial_estimate
from impslam.calibration.odometry_models import DifferentialDrive
from impslam.calibration.residuals import CalibrationDrive


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 3.0, -2.0])
@pytest.mark.parametrize(("model", "true"), [(wheels(40.0)[0], TRUE), (twists(40.0), SCALES)])
def test_exact_without_noise(model, true, yaw):
    true = np.where(np.arange(9) == 5, yaw, true)
    found = initial_estimate([drive(model, true=true)], 0.0)
    np.testing.assert_allclose(found, true, atol=1e-6)


def test_several_drives():
    two = [drive(wheels(10.0)[0]), drive(wheels(25.0)[0])]
    np.testing.assert_allclose(initial_estimate(two, 0.04), TRUE, atol=1e-6)


def test_bad_matches_are_downweighted(rng):
    of = drive(wheels(60.0)[0], rng=rng)
    wrong = rng.choice(len(of.motions.begins), 12, replace=False)
    of.motions.T_begin_end[wrong] += rng.normal(0.0, [0.5, 0.5, 0.5], (12, 3))
    found = initial_estimate([of], 0.0)
    np.testing.assert_allclose(found[:6], TRUE[:6], atol=0.02)


def test_no_estimate_without_motion():
    assert initial_estimate([CalibrationDrive(wheels(10.0)[0], none())], 0.0) is None


def test_few_turns_give_the_latency(rng):
    """Most motions are straight and contain no information on it."""
    speed, turns = np.full(3000, 0.4), np.zeros(3000)
    for begin in (400, 1200, 2300):
        turns[begin : begin + 100] = 0.8 * np.sign(begin - 1000)
    off = 0.5 * TRUE[2] * turns
    left, right = (speed - off) / 50.0 / TRUE[0], (speed + off) / 50.0 / TRUE[0] / TRUE[1]
    model = DifferentialDrive(np.arange(3001) / 50.0, np.zeros(3000, bool), left, right)
    found = initial_estimate([drive(model, rng=rng)], 0.3)
    assert abs(found[6] - TRUE[6]) < 0.05
    assert abs(found[2] - TRUE[2]) < 0.03
