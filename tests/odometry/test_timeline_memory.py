"""Odometry without scans: memory is bounded and no motion is lost."""

import numpy as np

from impslam.odometry import timeline as module
from impslam.odometry.timeline import Timeline
from impslam.types import Increment


def drive(n):
    timeline = Timeline()
    for i in range(n):
        d_pose = np.array([0.01, 0.001, 0.02 * np.sin(0.1 * i)])
        timeline.add(Increment(0.01 * (i + 1), d_pose, 1e-6 * np.eye(3), 0.01))
        if i % 7 == 0:
            timeline.all_ahead()
    return timeline


def test_motion_without_scans_takes_bounded_memory(monkeypatch):
    whole = drive(1000).take(9.995)
    monkeypatch.setattr(module, "MOST", 50)
    timeline = drive(1000)
    assert len(timeline._pending) <= 51
    np.testing.assert_allclose(timeline.all_ahead().d_pose, timeline.ahead(10.0).d_pose, atol=1e-12)
    folded = timeline.take(9.995)
    np.testing.assert_allclose(folded.d_pose, whole.d_pose, atol=1e-12)
    np.testing.assert_allclose(folded.covariance, whole.covariance, rtol=1e-9)
    assert abs(folded.duration - whole.duration) < 1e-9
    assert folded.stamp == whole.stamp
