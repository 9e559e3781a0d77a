"""A scan that is stamped late is used where it was taken and reported at its stamp."""

import numpy as np

from impslam.geometry.se2 import exp
from impslam.odometry.timeline import Timeline
from impslam.types import Increment


def test_what_is_ahead_is_told_and_kept():
    twist = np.array([0.5, 0.0, 0.4])
    timeline = Timeline()
    timeline.start(0.0)
    for k in range(10):
        timeline.add(Increment(0.1 * (k + 1), exp(0.1 * twist), np.eye(3) * 1e-4, 0.1))
    timeline.take(0.25)
    ahead = timeline.ahead(0.7)
    np.testing.assert_allclose(ahead.d_pose, exp(0.45 * twist), atol=1e-12)
    np.testing.assert_allclose(timeline.take(0.7).d_pose, exp(0.45 * twist), atol=1e-12)


def test_advance_carries_pose_and_covariance():
    motion = Increment(1.0, np.array([1.0, 0.0, 0.2]), np.diag([1e-2, 2e-2, 1e-3]), 1.0)
    pose, covariance = motion.advance(np.array([2.0, 3.0, np.pi / 2]), np.diag([0, 0, 0.01]))
    np.testing.assert_allclose(pose, [2.0, 4.0, np.pi / 2 + 0.2])
    # 1 m ahead of a heading known to 0.1 rad; body x lies along map y.
    np.testing.assert_allclose(np.diag(covariance), [0.01 + 2e-2, 1e-2, 0.011], atol=1e-12)
