"""Wheels that slip: what they report beyond the robot's speed is in the covariance."""

import numpy as np
import pytest

from impslam.health import NONE, SLIPPED
from impslam.noise import UNKNOWN
from impslam.tracking.traction import SLIP_TIMEOUT, Traction

PERIOD = 0.1


def widened(distances, cuts=(), seconds=None, unknown=()):
    """Return the reasons and the added variances (m,) of these distances in m, one every 0.1 s."""
    d_pose = np.zeros((len(distances), 3))
    d_pose[:, 0] = distances
    covariance = np.zeros((len(distances), 3, 3))
    covariance[list(unknown), 0, 0] = UNKNOWN
    duration = np.full(len(distances), PERIOD) if seconds is None else np.asarray(seconds)
    traction = Traction()
    parts = zip(*(np.split(column, cuts) for column in (duration, d_pose, covariance)), strict=True)
    reasons = [traction.widen(*part) for part in parts]  # views
    return np.concatenate(reasons), covariance[:, 0, 0]


def slip(at_once=0.1, sweeps=5):
    distances = np.full(60, 0.05)
    distances[30 : 30 + sweeps] += at_once
    return distances


@pytest.mark.parametrize("cuts", [(), (31,), (30, 32, 33), tuple(range(1, 60))])
def test_the_excess_is_in_the_covariance_however_the_log_is_cut(cuts):
    reasons, variances = widened(slip(), cuts)
    assert np.flatnonzero(reasons == SLIPPED).tolist() == [30, 31, 32, 33, 34]
    assert variances.sum() == pytest.approx(0.5**2)  # all of it may be wrong at once
    assert variances[:30].sum() == variances[35:].sum() == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_either_direction_counts(sign):
    assert (widened(sign * slip())[0] == SLIPPED).sum() == 5


def test_a_robot_that_speeds_up_as_motors_do_does_not_slip():
    speeds = np.minimum(2.0 * PERIOD * np.arange(60), 1.0)  # 2 m/s^2
    assert (widened(speeds * PERIOD)[0] == NONE).all()


def test_a_robot_that_a_wall_stops_does_not_slip():
    distances = np.full(40, 0.1)
    distances[20:] = 0.0
    assert (widened(distances)[0] == NONE).all()


def test_a_new_speed_that_lasts_is_accepted():
    distances = np.full(100, 0.05)
    distances[30:] = 0.15
    reasons, _ = widened(distances)
    assert (reasons == SLIPPED).sum() == pytest.approx(SLIP_TIMEOUT / PERIOD, abs=1)
    assert (reasons[70:] == NONE).all()


def test_uneven_stamps_are_no_slip():
    rng = np.random.default_rng(0)
    seconds = rng.uniform(0.02, 0.18, 400)
    reasons, _ = widened(np.full(400, 0.05), seconds=seconds)
    assert (reasons[20:] == SLIPPED).mean() < 0.02


def test_any_speed_is_accepted_after_an_unknown_motion():
    distances = slip()
    assert (widened(distances, unknown=[29])[0][:31] == NONE).all()
