"""What every odometry keeps: increments that compose, and a fresh start after what is bad."""

import math

import numpy as np
import pytest
from tests.numeric import wrapped

from impslam.component import components
from impslam.errors import MessageError
from impslam.geometry.se2 import compose, exp
from impslam.types import Increment, OdometryPose, Steering, Velocity, WheelAngles

NEEDED = {
    "ackermann": {"wheelbase": 0.5, "encoder_offset": 0.3},
    "encoders": {"wheel_radius": 0.05, "track": 0.3},
}
TWIST = np.array([0.4, 0.0, 0.7])
PLACES = (WheelAngles, OdometryPose)
"""Readings of where something is: a wrong one spoils the motion before it and after it."""


def reading(consumes, stamp, spoil=None):
    """Return the message of a robot that has gone at TWIST since 0 s."""
    if consumes is WheelAngles:
        v, w = TWIST[0], TWIST[2]
        left, right = ((v + side * w * 0.15) * stamp / 0.05 for side in (-1, 1))
        return WheelAngles(stamp, left if spoil is None else spoil, right)
    if consumes is Steering:
        speed, curvature = TWIST[0], TWIST[2] / TWIST[0]
        wheel = speed * (1.0 - 0.3 * curvature)
        return Steering(stamp, wheel if spoil is None else spoil, math.atan(0.5 * curvature))
    if consumes is Velocity:
        return Velocity(stamp, float(TWIST[0]) if spoil is None else spoil, float(TWIST[2]))
    pose = exp(TWIST * stamp)
    return OdometryPose(stamp, pose if spoil is None else np.array([spoil, *pose[1:]]))


@pytest.fixture(params=sorted(components("odometry")))
def odometry(request):
    return components("odometry")[request.param](**NEEDED.get(request.param, {}))


def test_the_first_message_tells_no_motion(odometry):
    assert odometry.update(reading(odometry.consumes, 1.0)) is None


def test_increments_compose_to_the_motion(odometry):
    stamps = np.cumsum(np.random.default_rng(2).uniform(0.005, 0.1, 40))
    total = None
    for stamp in stamps:
        increment = odometry.update(reading(odometry.consumes, float(stamp)))
        if increment is not None:
            assert increment.duration > 0.0
            assert np.linalg.eigvalsh(increment.covariance)[0] >= -1e-18
            np.testing.assert_allclose(increment.covariance, increment.covariance.T, rtol=1e-12)
            total = increment if total is None else total.then(increment)
    moved = compose(exp(TWIST * stamps[0]), total.d_pose)
    np.testing.assert_allclose(wrapped(moved - exp(TWIST * stamps[-1]), 2), 0.0, atol=1e-12)
    assert total.duration == pytest.approx(stamps[-1] - stamps[0])


def test_uncertainty_does_not_depend_on_the_rate(odometry):
    """Ten small increments are as sure as one large one, to first order in the turn."""
    fresh = type(odometry)(**odometry.model_dump())
    for belief, steps in ((odometry, 1), (fresh, 10)):
        belief.update(reading(belief.consumes, 0.0))
        total = Increment.none(0.0)
        for k in range(1, steps + 1):
            total = total.then(belief.update(reading(belief.consumes, 0.05 * k / steps)))
        if steps == 1:
            once = total.covariance
    np.testing.assert_allclose(np.diag(total.covariance), np.diag(once), rtol=0.02, atol=1e-9)


def test_no_motion_is_sure(odometry):
    odometry.update(reading(odometry.consumes, 1.0))
    increment = odometry.update(reading(odometry.consumes, 1.0))
    np.testing.assert_allclose(increment.d_pose, np.zeros(3), atol=1e-15)
    assert np.abs(increment.covariance).max() < 1e-12


def test_a_stamp_that_runs_backwards_takes_no_time(odometry):
    odometry.update(reading(odometry.consumes, 1.0))
    assert odometry.update(reading(odometry.consumes, 0.99)).duration == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6])
def test_a_bad_message_is_refused_in_one_line(odometry, bad):
    consumes = odometry.consumes
    odometry.update(reading(consumes, 1.0))
    with pytest.raises(MessageError) as error:
        odometry.update(reading(consumes, 1.1, bad))
    assert "\n" not in str(error.value)
    if bad == 1e6 and consumes in PLACES:  # a jump there and back
        with pytest.raises(MessageError):
            odometry.update(reading(consumes, 1.2))
    else:
        odometry.update(reading(consumes, 1.2))
    after = odometry.update(reading(consumes, 1.3))
    np.testing.assert_allclose(after.d_pose, exp(TWIST * 0.1), atol=1e-9)
