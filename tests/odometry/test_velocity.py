"""Velocities against the closed form of an arc, their calibration, and what is refused."""

import math

import numpy as np
import pytest
from tests.odometry_steps import StepwiseOdometry

from impslam.errors import MessageError
from impslam.geometry.se2 import exp
from impslam.noise import MotionNoise
from impslam.odometry.odometry_pose import OdometryPoses
from impslam.odometry.velocity import Velocities
from impslam.types import OdometryPose, Velocity


def test_a_velocity_is_valid_until_the_next_one():
    """A quarter of a circle of radius 2 m in 1 s; what is commanded at its end changes nothing."""
    odometry = StepwiseOdometry(Velocities())
    odometry.update(Velocity(1.0, math.pi, math.pi / 2))
    increment = odometry.update(Velocity(2.0, 0.0, -3.0))
    np.testing.assert_allclose(increment.d_pose, [2.0, 2.0, math.pi / 2], atol=1e-12)
    assert (increment.stamp, increment.duration) == (2.0, 1.0)


def test_calibration_scales_and_delays():
    odometry = StepwiseOdometry(Velocities(speed_scale=0.9, turn_scale=0.8, latency=0.25))
    odometry.update(Velocity(1.0, 1.0, 0.5))
    increment = odometry.update(Velocity(2.0, 0.0, 0.0))
    np.testing.assert_allclose(increment.d_pose, exp(np.array([0.9, 0.0, 0.4])), atol=1e-12)
    assert (increment.stamp, increment.duration) == (2.25, 1.0)


def test_standing_still_adds_no_uncertainty():
    odometry = StepwiseOdometry(Velocities())
    odometry.update(Velocity(1.0, 0.0, 0.0))
    increment = odometry.update(Velocity(2.0, 1.0, 1.0))
    assert not increment.d_pose.any()
    assert not increment.covariance.any()


def test_noise_is_that_of_the_true_distance():
    noise = MotionNoise(forward=0.1, sideways=0.2, turn_per_distance=0.0, turn_per_turn=0.3)
    odometry = StepwiseOdometry(Velocities(speed_scale=0.5, noise=noise))
    odometry.update(Velocity(1.0, 1.0, 0.0))
    increment = odometry.update(Velocity(2.0, 0.0, 0.0))
    np.testing.assert_allclose(np.diag(increment.covariance), [0.005, 0.02, 0.0], atol=1e-15)


def test_a_long_silence_is_not_driven_through():
    odometry = StepwiseOdometry(Velocities(max_hold=2.0))
    odometry.update(Velocity(1.0, 0.5, 0.0))
    with pytest.raises(MessageError, match=r"no velocity for 5\.0 s before 6\.000 s.*max_hold"):
        odometry.update(Velocity(6.0, 0.25, 0.0))
    assert odometry.update(Velocity(7.0, 0.0, 0.0)).d_pose[0] == pytest.approx(0.25)


@pytest.mark.parametrize(("speed", "turn_rate"), [(11.0, 0.0), (0.0, -11.0), (math.nan, 0.0)])
def test_a_wild_velocity_is_not_driven(speed, turn_rate):
    odometry = StepwiseOdometry(Velocities())
    odometry.update(Velocity(1.0, 0.5, 0.0))
    with pytest.raises(MessageError, match="check the log"):
        odometry.update(Velocity(1.1, speed, turn_rate))
    assert odometry.update(Velocity(1.2, 0.5, 0.0)) is None
    assert odometry.update(Velocity(1.3, 0.5, 0.0)).d_pose[0] == pytest.approx(0.05)


def test_drift_of_poses_grows_with_time_while_they_move():
    quiet = MotionNoise(forward=0, sideways=0, turn_per_distance=0, turn_per_turn=0)
    odometry = StepwiseOdometry(OdometryPoses(noise=quiet, drift=(0.3, 0.2, 0.1)))
    odometry.update(OdometryPose(0.0, np.zeros(3)))
    moved = odometry.update(OdometryPose(2.0, np.array([0.0, 0.0, 0.4])))
    np.testing.assert_allclose(moved.covariance, 2.0 * np.diag([0.09, 0.04, 0.01]))
    still = odometry.update(OdometryPose(3.0, np.array([0.0, 0.0, 0.4])))
    assert not still.covariance.any()
