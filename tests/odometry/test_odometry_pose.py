"""Poses from a robot's own odometry: what their motions are worth after a gap."""

import numpy as np
import pytest
from tests.odometry_steps import StepwiseOdometry

from impslam.noise import MAX_GAP, MIN_BREAK, MotionNoise
from impslam.odometry.odometry_pose import OdometryPoses
from impslam.types import OdometryPose

EXACT = MotionNoise(forward=0.0, sideways=0.0, turn_per_distance=0.0, turn_per_turn=0.0)


def motion_over(seconds, x=4.0):
    """Return the motion between two poses x m apart, the second one `seconds` later."""
    odometry = StepwiseOdometry(OdometryPoses(noise=EXACT))
    odometry.update(OdometryPose(1.0, np.zeros(3)))
    return odometry.update(OdometryPose(1.0 + seconds, np.array([x, 0.0, 0.0])))


@pytest.mark.parametrize(
    ("seconds", "sigma"), [(2.0 * MAX_GAP, 0.0), (0.5 * MIN_BREAK, 0.0), (2.0 * MIN_BREAK, 2.0)]
)
def test_a_jump_over_a_break_may_be_no_motion(seconds, sigma):
    """Half of the distance between both poses is one standard deviation; a shorter gap adds nothing."""
    covariance = motion_over(seconds).covariance
    np.testing.assert_allclose(covariance, np.diag([sigma, sigma, 0.0]) ** 2, atol=1e-12)


def test_a_robot_that_stands_still_during_a_gap_stays_where_it_is():
    motion = motion_over(1000.0, x=0.0)
    assert not motion.d_pose.any()
    assert not motion.covariance.any()
