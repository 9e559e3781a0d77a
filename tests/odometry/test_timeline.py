"""Increments compose exactly, however they are cut."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.numeric import wrapped

from impslam.errors import MessageError
from impslam.geometry.se2 import compose, exp
from impslam.odometry.odometry_pose import OdometryPoses
from impslam.odometry.timeline import Timeline
from impslam.types import Increment, OdometryPose

TWIST = np.array([0.5, 0.1, 0.8])


def increments(stamps):
    q = np.diag([1e-4, 2e-4, 3e-4])
    return [Increment(b, exp((b - a) * TWIST), (b - a) * q, b - a) for a, b in pairwise(stamps)]


@given(st.floats(0.0, 1.0))
def test_split_parts_compose_to_the_whole(fraction):
    whole = Increment(2.0, exp(TWIST), np.diag([1e-2, 2e-2, 3e-2]) + 1e-3, 1.0)
    head, tail = whole.split(fraction)
    again = head.then(tail)
    np.testing.assert_allclose(again.d_pose, whole.d_pose, atol=1e-12)
    np.testing.assert_allclose(again.covariance, whole.covariance, atol=1e-12)
    assert (again.stamp, again.duration) == (2.0, pytest.approx(1.0))


@given(st.lists(st.floats(0.01, 4.99), min_size=1, max_size=8))
def test_scans_at_any_time_get_the_motion_up_to_it(times):
    timeline = Timeline()
    timeline.start(0.0)
    for increment in increments(np.linspace(0, 5, 26)):
        timeline.add(increment)
    pose = np.zeros(3)
    for time in sorted(times):
        pose = compose(pose, timeline.take(time).d_pose)
        assert np.abs(wrapped(pose - exp(time * TWIST), 2)).max() < 1e-9
        np.testing.assert_allclose(timeline.twist(time, 0.1), TWIST, atol=1e-9)


def test_covariance_of_a_composition_by_monte_carlo(rng):
    first = Increment(1.0, np.array([0.4, 0.1, 0.5]), np.diag([1e-4, 2e-4, 1e-3]), 1.0)
    second = Increment(2.0, np.array([0.3, -0.1, -0.2]), np.diag([3e-4, 1e-4, 2e-3]), 1.0)
    total = first.then(second)
    ends = np.array(
        [
            compose(
                first.d_pose + rng.multivariate_normal(np.zeros(3), first.covariance),
                second.d_pose + rng.multivariate_normal(np.zeros(3), second.covariance),
            )
            for _ in range(20000)
        ]
    )
    np.testing.assert_allclose(np.cov(ends.T), total.covariance, atol=6e-5)


def test_a_scan_recorded_with_odometry_gets_all_motion_though_stamps_run_back():
    timeline = Timeline()
    timeline.start(10.0)
    for stamp in (10.1, 10.9, 10.3):
        timeline.add(Increment(stamp, np.array([1.0, 0, 0]), np.eye(3), 0.1))
    np.testing.assert_allclose(timeline.take(10.3).d_pose, [3.0, 0, 0])


def test_poses_give_increments_in_the_body_frame():
    odometry = OdometryPoses()
    assert odometry.update(OdometryPose(0.0, np.array([5.0, 5.0, np.pi / 2]))) is None
    increment = odometry.update(OdometryPose(1.0, np.array([5.0, 6.0, np.pi])))
    np.testing.assert_allclose(increment.d_pose, [1.0, 0.0, np.pi / 2], atol=1e-12)
    with pytest.raises(MessageError, match="jumps"):
        odometry.update(OdometryPose(1.1, np.array([500.0, 6.0, 0])))
    increment = odometry.update(OdometryPose(1.2, np.array([500.5, 6.0, 0])))
    np.testing.assert_allclose(increment.d_pose, [0.5, 0, 0], atol=1e-12)


@given(st.lists(st.sampled_from(["add", "look", "take", "put back"]), max_size=30))
def test_all_ahead_is_all_that_was_not_taken(steps):
    """Whatever happens between two looks, also where what was added up before is gone."""
    timeline, time, taken = Timeline(), 0.0, Increment.none(0.0)
    timeline.start(0.0)
    for step in steps:
        if step == "add":
            timeline.add(increments([time, time + 0.2])[0])
            time += 0.2
        elif step == "look":
            timeline.all_ahead()
        elif step == "take":
            taken = timeline.take(0.7 * time)
        else:
            timeline.put_back(taken)
            taken = Increment.none(0.0)
    found, want = timeline.all_ahead(), timeline.ahead(time)
    np.testing.assert_allclose(found.d_pose, want.d_pose, atol=1e-12)
    np.testing.assert_allclose(found.covariance, want.covariance, atol=1e-12)
    assert found.duration == pytest.approx(want.duration)
    assert found.stamp == pytest.approx(want.stamp) or not timeline._pending
