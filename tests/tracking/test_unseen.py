"""Surfaces that come into view behind a door say nothing about the pose."""

import math

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.tracking.test_scan_to_map import drive, odometry_of, scans_from, straight

from impslam.surfaces.surface_map import add, empty_surface_map
from impslam.tracking.beams import Geometry
from impslam.tracking.reference_scan import LastScan
from impslam.tracking.unseen import unseen_points

BEAMS = Geometry(np.array([0.2, 0.0, 0.0]), -math.pi, math.tau / 360)


def features(point, normal=(-1.0, 0.0)):
    """Return a feature on a surface."""
    return np.array([(*point, *normal, 1.0)], np.float32)


@pytest.mark.parametrize(
    ("point", "normal", "is_unseen"),
    [
        ((3.0, 0.0), (-1.0, 0.0), True),  # behind what the last scan saw
        ((2.1, 0.0), (-1.0, 0.0), True),  # there
        ((1.0, 0.0), (-1.0, 0.0), False),  # it saw through
        ((0.0, 3.0), (0.0, -1.0), False),  # it saw nothing in this direction
        ((0.2, -3.0), (0.0, 1.0), False),  # a surface of the map is near
        ((0.2, -3.0), (0.0, -1.0), True),  # its other side
    ],
)
@pytest.mark.parametrize("turn", [0.0, 0.8])
@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_a_point_is_unseen_if_the_last_scan_ended_there_or_before(
    point, normal, is_unseen, shift, turn
):
    """The last scan was taken at the origin, this one `shift` m further on, turned by `turn` rad."""
    submap, ranges = empty_surface_map(20.0, 20.0, 100), np.zeros(360)
    add(submap, features((0.2, -3.2), (0.0, 1.0)), np.zeros(3), 20.0)
    ranges[170:191] = 1.9  # ahead: 2.1 m from base_link
    ranges[80:101] = 0.9  # to the right
    last = LastScan(ranges, np.zeros(3), BEAMS)
    c, s = math.cos(turn), math.sin(turn)
    R = np.array([[c, s], [-s, c]])
    scan = features(R @ (np.array(point) - [shift, 0.0]), R @ normal)
    pose, blind = np.array([shift, 0.0, turn]), last._replace(ranges=np.zeros(0))
    assert unseen_points(submap, scan, pose, last) == is_unseen
    assert unseen_points(submap, scan, pose, blind) == 0


@pytest.mark.parametrize("seed", range(16))
def test_a_door_is_passed_at_the_pose_of_odometry(seed):
    """Walls behind the door are in line with those before, so they also fit half a metre further back.

    The lidar sees 3.5 m, with the noise of a cheap one at that distance.
    """
    rng, width = np.random.default_rng(seed), (5.0, 5.8)[seed % 2]
    y = (0.42, 0.5)[seed // 2 % 2] * width
    divider = np.array([[[5.9, 0.0], [5.9, y - 0.5]], [[5.9, y + 0.5], [5.9, width]]])
    other_side = divider[:, ::-1] + np.array([0.1, 0.0])
    walls = np.concatenate((room(0.0, 12.0, 0.0, width), divider, other_side))
    poses = straight(30, step=0.2, start=(3.0, y, 0.0))
    increments = odometry_of(poses, rng.normal(size=(30, 3)) * 0.005)
    scans = scans_from(poses, lines=walls, range_max=3.5, noise=0.035, rng=rng)
    _, _, off = drive(poses, increments, scans)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.3
