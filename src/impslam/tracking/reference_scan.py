"""Predict what a beam measures after a motion, from the scan before it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.tracking.beams import Geometry
from impslam.types import Array

MIN_MOTION = (0.2, 0.15)
"""m, rad: motion by odometry before a scan is compared with the reference scan; ranges change by more than
noise."""
MIN_CHANGE = 0.1
"""m: predicted change of a range that is large enough to be tested: ten times a lidar's noise."""

RANGE_TOLERANCE = (0.03, 0.005)
"""m, and share of the range: a smaller change counts as none; 3 sigma of the noise."""


class LastScan(NamedTuple):
    """The scan of a lidar that was matched before.

    Attributes
    ----------
    ranges : (n,) m, 0 where invalid
    pose : (3,) of base_link, in the frame of the submaps
    geometry : of its beams
    """

    ranges: Array
    pose: Array
    geometry: Geometry


@kernel
def changed_beam(
    j: int, motion: Array, points: Array, ranges: Array, geometry: Geometry
) -> tuple[int, float]:
    """Return the beam that hits point j of a reference scan after a motion (3,), and its range, m.

    The beam is -1 if its range does not change, if there is no such beam, or if all beams have the same
    direction. `points` (n, 2) are in base_link; `ranges` (n,), m, are 0 where invalid.
    """
    if ranges[j] <= 0.0 or geometry.spacing == 0.0:
        return -1, 0.0
    n, laser, c, s = len(ranges), geometry.laser, math.cos(motion[2]), math.sin(motion[2])
    x, y = points[j, 0] - motion[0], points[j, 1] - motion[1]
    dx, dy = c * x + s * y - laser[0], c * y - s * x - laser[1]
    k = beam_towards(math.atan2(dy, dx) - laser[2], n, geometry)
    if k < 0 or ranges[k] <= 0.0:
        return -1, 0.0
    shortest = longest = ranges[k]  # on a grazed wall, neighbours measure very different ranges
    for i in range(max(k - 1, 0), min(k + 2, n)):
        shortest, longest = min(shortest, ranges[i]), max(longest, ranges[i])
    expected = math.hypot(dx, dy)
    changed = expected < shortest - MIN_CHANGE or expected > longest + MIN_CHANGE
    return (k if changed else -1), expected


@kernel
def beam_towards(direction: float, beams: int, geometry: Geometry) -> int:
    """Return the beam nearest to a direction, rad in the laser's frame; -1 if there is none.

    There is also none if all beams have the same direction.
    """
    if geometry.spacing == 0.0:
        return -1
    angle = direction - geometry.first
    angle -= 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
    k = math.floor(angle / geometry.spacing + 0.5)
    if k < 0:
        angle += math.copysign(2.0 * math.pi, geometry.spacing)
        k = math.floor(angle / geometry.spacing + 0.5)
    return k if k < beams else -1


@kernel
def ranges_at_once(ranges: Array, directions: Array, geometry: Geometry) -> Array:
    """Return the ranges (n,) of a sweep in the directions of its beams as if taken at once, else 0.

    A turn by 2.5 rad/s moves the beams at either end of a sweep of 0.1 s by 7 deg. `directions` (n,) rad
    are those of the de-skewed sweep in base_link. Their offsets change slowly from beam to beam, so the
    beam in a direction is found by the offset of the one that should have it, then of the one found.
    """
    n, out = len(ranges), np.zeros(len(ranges))
    for k in range(n):
        i = k
        for attempt in range(2 if geometry.spacing != 0.0 else 0):
            off = directions[i] - geometry.laser[2] - geometry.first - i * geometry.spacing
            if attempt == 0 and abs(off) < 0.5 * abs(geometry.spacing):  # nearly always
                break
            off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
            i = k - math.floor(off / geometry.spacing + 0.5)
            if not 0 <= i < n:
                break
        if 0 <= i < n:
            out[k] = ranges[i]
    return out


@kernel
def laser_motion(before: Array, after: Array, geometry: Geometry) -> Array:
    """Return the pose (3,) of the laser after a motion of base_link, in its frame before."""
    first, second, motion = before.copy(), after.copy(), np.empty(3)
    advance_pose(first, geometry.laser)
    advance_pose(second, geometry.laser)
    between(first, second, motion)
    return motion


@kernel
def seen_from(
    i: int, reach: float, T_other_laser: Array, beams: int, geometry: Geometry
) -> tuple[int, float]:
    """Return the beam of another scan that points to the end of beam i, and the range there in m."""
    angle = geometry.first + i * geometry.spacing + T_other_laser[2]
    x = T_other_laser[0] + reach * math.cos(angle)
    y = T_other_laser[1] + reach * math.sin(angle)
    return beam_towards(math.atan2(y, x), beams, geometry), math.hypot(x, y)
