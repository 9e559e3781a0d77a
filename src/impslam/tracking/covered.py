"""Beams that end on what moves along with the robot: a cable, a cover, an arm, its own body.

Such points look like a wall that stands still, and hold the pose back. A reference scan is kept. When
odometry has told of enough motion since, each of its points has another place in view. A beam that should
measure something else by then and measures what it did is hidden from what follows. So are its neighbours
on the same surface, because motion does not change all ranges of a round cover. A beam that has changed is
free again. If nearly all beams measure what they did, the robot stands instead; see `standing`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Scans
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel, plain
from impslam.tracking.reference_scan import Geometry, changed_beam, geometry_of
from impslam.types import Array, Ints, Mask

TOLD = (0.2, 0.15)
"""m, rad: motion that odometry tells of before scans are compared; ranges change by more than noise."""
SAME = (0.04, 0.005)
"""m, and share of the range: a range that changed by less is the same: 3 sigma of the noise of both."""
NEAR = 1.0
"""m: nothing that a small robot carries is farther from its lidar."""
TIMES = 3
"""Comparisons in a row, 0.6 m of way, in which a beam has to measure the same."""
LEAST = 0.02
"""Share of the beams that have to, though they should not, at least: fewer may follow a table leg or a
person, or a bush."""
MOVES = 0.3
"""Share of the other beams that should change, that have to have changed: the robot moves."""
EDGE = 0.1
"""m between neighbours of one surface at most."""


class Cover(NamedTuple):
    """The reference scan of one lidar, the motion since, and what is held against beams.

    Attributes
    ----------
    ranges, points : (n,) m and (n, 2) m in base_link, of the reference scan; 0 where invalid
    told : (3,) motion since then, by odometry
    same : (n,) comparisons in a row in which the range was the same
    against : (n,) and in which it should not have been
    hidden : (n,) beams to be left out
    known : (1,) whether there is a reference scan
    """

    ranges: Array
    points: Array
    told: Array
    same: Ints
    against: Ints
    hidden: Mask
    known: Mask


def no_cover(beams: int) -> Cover:
    """Return what is known before the first scan of a lidar with so many beams."""
    counts = np.zeros((2, beams), np.int64)
    return Cover(
        np.zeros(beams), np.zeros((beams, 2)), np.zeros(3), counts[0], counts[1],
        np.zeros(beams, np.bool_), np.zeros(1, np.bool_),
    )  # fmt: skip


def hidden_beams(d_pose: Array, scans: Scans, cover: Cover) -> Mask:
    """Return which beams (m, n) of scans to leave out; `d_pose` (m, 3) is by odometry, before each."""
    geometry = geometry_of(scans)
    out = np.zeros(scans.valid.shape, np.bool_)
    valid = np.ascontiguousarray(scans.valid)
    _hide(d_pose, plain(scans.points), plain(scans.ranges), valid, geometry, cover, out)
    return out


@kernel
def _hide(
    d_pose: Array,
    points: Array,
    ranges: Array,
    valid: Mask,
    geometry: Geometry,
    cover: Cover,
    out: Mask,
) -> None:
    for k in range(len(d_pose)):
        advance_pose(cover.told, d_pose[k])
        far = math.hypot(cover.told[0], cover.told[1]) >= TOLD[0] or abs(cover.told[2]) >= TOLD[1]
        if far or not cover.known[0]:
            if cover.known[0]:
                _compare(ranges[k], valid[k], geometry, cover)
            cover.known[0], cover.told[:], cover.points[:] = True, 0.0, points[k]
            for i in range(len(cover.ranges)):
                cover.ranges[i] = ranges[k, i] if valid[k, i] else 0.0
        if cover.hidden.any():
            out[k] = cover.hidden & valid[k]


@kernel
def _compare(ranges: Array, valid: Mask, geometry: Geometry, cover: Cover) -> None:
    """Hold a scan against the beams that measure the same, and find the hidden ones."""
    n, should = len(ranges), np.zeros(len(ranges), np.bool_)
    for j in range(n):
        k = changed_beam(j, cover.told, cover.points, cover.ranges, geometry)
        if k >= 0:
            should[k] = True
    changed = others = 0
    for i in range(n):
        r = cover.ranges[i]
        same = valid[i] and r > 0.0 and abs(ranges[i] - r) < SAME[0] + SAME[1] * r
        near = same and r < NEAR
        cover.same[i] = cover.same[i] + 1 if near else 0
        cover.against[i] = cover.against[i] + should[i] if near else 0
        if should[i] and r >= NEAR:
            others += 1
            changed += not same
    cover.hidden[:] = False
    if np.sum(cover.against >= TIMES) < LEAST * n or changed < MOVES * others:
        return
    for i in range(n):
        if cover.against[i] >= TIMES:
            _spread(i, 1, ranges, cover)
            _spread(i, -1, ranges, cover)


@kernel
def _spread(first: int, step: int, ranges: Array, cover: Cover) -> None:
    """Hide a beam and its neighbours on one side, as far as they have measured the same on one surface."""
    i = first
    while 0 <= i < len(ranges) and cover.same[i] >= TIMES:
        if i != first and abs(ranges[i] - ranges[i - step]) > EDGE:
            break
        cover.hidden[i] = True
        i += step
