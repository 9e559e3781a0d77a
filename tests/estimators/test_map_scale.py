"""Covariances include that of the map's scale: numerical derivatives, and runs with wrong ranges."""

from __future__ import annotations

import math

import numpy as np
import pytest

from impslam.estimators.map_scale import joint_with_scale, landmark_with_scale, with_scale
from impslam.slam import Slam
from impslam.types import Landmark

ORIGIN, SIGMA = np.array([3.0, -2.0]), 0.02
ROOM = np.array([20.0, 8.0])  # m; the robot drives along its middle


def scaled(point, scale):
    return ORIGIN + scale * (point - ORIGIN)


def test_a_pose_varies_with_the_scale_as_its_position_does():
    pose, step = np.array([7.0, 1.0, 0.4]), 1e-6
    J = np.zeros(3)
    J[:2] = (scaled(pose[:2], 1 + step) - scaled(pose[:2], 1 - step)) / (2 * step)
    added = with_scale(np.eye(3)[None], pose[None], ORIGIN, SIGMA)[0] - np.eye(3)
    np.testing.assert_allclose(added, SIGMA**2 * np.outer(J, J), atol=1e-12)


def test_the_first_pose_is_as_certain_as_before():
    first = np.array([[*ORIGIN, 1.0]])
    np.testing.assert_array_equal(with_scale(np.eye(3)[None], first, ORIGIN, SIGMA), [np.eye(3)])


@pytest.mark.parametrize("alpha", [0.3, 2.0, -1.2])
def test_a_wall_varies_with_the_scale_as_its_distance_does(alpha):
    normal = np.array([math.cos(alpha), math.sin(alpha)])
    foot, step = 5.0 * normal, 1e-6
    J = np.array([normal @ (scaled(foot, 1 + step) - scaled(foot, 1 - step)) / (2 * step), 0.0])
    wall = Landmark(1, "wall", foot, {"r": 5.0, "alpha": alpha}, np.eye(2), None, 3, 0.0, 1.0)
    added = landmark_with_scale(wall, ORIGIN, SIGMA).covariance - np.eye(2)
    np.testing.assert_allclose(added, SIGMA**2 * np.outer(J, J), atol=1e-12)


def test_a_point_varies_with_the_scale_as_its_position_does():
    post = Landmark(1, "cylinder", np.array([1.0, 4.0]), {}, np.eye(2), None, 3, 0.0, 1.0)
    added = landmark_with_scale(post, ORIGIN, SIGMA).covariance - np.eye(2)
    off = post.position - ORIGIN
    np.testing.assert_allclose(added, SIGMA**2 * np.outer(off, off), atol=1e-12)


def ranges_in_room(x, angles):
    """Ranges from (x, 0) to the walls of a room with the corner (-2, -h / 2), heading along x."""
    ends = np.where(np.cos(angles) > 0.0, ROOM[0] - 2.0 - x, x + 2.0) / np.abs(np.cos(angles))
    return np.minimum(ends, 0.5 * ROOM[1] / np.maximum(np.abs(np.sin(angles)), 1e-9))


@pytest.mark.parametrize(
    ("error", "inside"), [(0.0, True), (0.03, True), (-0.03, True), (0.1, False)]
)
def test_ranges_that_are_too_long_leave_the_truth_inside_the_covariance(error, inside):
    """By 3 % the position is off by three standard deviations of the scale; by 10 % it is outside."""
    angles, way = np.radians(np.arange(-180.0, 180.0)), np.arange(0.0, 14.0, 0.1)
    ranges = np.array([ranges_in_room(x, angles) for x in way])
    slam = Slam("default", ["sensors.lidar.range_max=60"])
    stamps = 0.2 * np.arange(len(way))
    slam.add_odometry(stamps, np.column_stack([way, 0.0 * way, 0.0 * way]))
    slam.add_scans(stamps, (1.0 + error) * ranges, angles)
    off = slam.pose - [way[-1], 0.0, 0.0]
    assert abs(off[0]) == pytest.approx(abs(error) * way[-1], abs=0.1)
    squared = off @ np.linalg.solve(slam.covariance, off)
    assert (squared < 16.3) == inside  # 99.9 % of a chi-square with three degrees of freedom


@pytest.mark.parametrize("kind", ["landmarks", "smoothing"])
def test_landmark_estimators_add_the_scale_to_what_they_report(kind):
    if kind == "smoothing":
        pytest.importorskip("gtsam")
    angles, way = np.radians(np.arange(-180.0, 180.0)), np.arange(0.0, 8.0, 0.1)
    ranges, stamps = np.array([ranges_in_room(x, angles) for x in way]), 0.2 * np.arange(len(way))
    live, refined, marks, joints = [], [], [], []
    for sigma in (0.0, 0.02):
        sets = [f"estimator.kind={kind}", f"estimator.scale_sigma={sigma}"]
        slam = Slam("default", ["sensors.lidar.range_max=60", *sets])
        slam.add_odometry(stamps, np.column_stack([way, 0.0 * way, 0.0 * way]))
        slam.add_scans(stamps, ranges, angles)
        live.append(slam.covariance)
        known = slam.finish()
        refined.append(known.rows().covariances[-1])
        marks.append({m.id: m for m in known.landmarks})
        joints.append(known.landmark_covariance)
        last = known.rows().poses[-1]
    added = with_scale(np.zeros((1, 3, 3)), last[None], np.zeros(2), 0.02)[0]
    for found in (live, refined):  # a scan has the scale of the keyframe before it
        np.testing.assert_allclose(found[1] - found[0], added, rtol=0.05, atol=1e-6)
    assert marks[0]
    for number, mark in marks[0].items():
        both = landmark_with_scale(mark, np.zeros(2), 0.02).covariance
        np.testing.assert_allclose(marks[1][number].covariance, both, rtol=1e-6, atol=1e-12)
    if kind == "landmarks":
        both = joint_with_scale(joints[0], known.landmarks, np.zeros(2), 0.02)
        np.testing.assert_allclose(joints[1], both, rtol=1e-6, atol=1e-12)
    else:  # marginals of each landmark only
        assert not joints[1].size


def test_the_scale_is_common_to_all_landmarks():
    """The angle between two posts, seen from the origin, does not vary with it."""
    posts = [
        Landmark(k, "cylinder", ORIGIN + off, {}, np.eye(2), None, 3, 0.0, 1.0)
        for k, off in enumerate(([4.0, 0.0], [2.0, 0.0]))
    ]
    added = joint_with_scale(np.eye(4), posts, ORIGIN, SIGMA) - np.eye(4)
    ratio = np.array([1.0, 0.0, -2.0, 0.0])
    assert ratio @ added @ ratio == pytest.approx(0.0, abs=1e-15)
    assert added[0, 2] == pytest.approx(SIGMA**2 * 8.0)
