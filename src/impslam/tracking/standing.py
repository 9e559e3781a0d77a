"""Whether the robot stands while its wheels turn: against a wall, on a threshold, on its belly.

A reference scan is kept. When odometry has told of enough motion since, the ranges that this motion would
have changed are predicted from it: each point, seen from where odometry says that the robot is, is compared
with the range that the beam in its direction measured before. If nearly all beams that should have changed
measure what they did, the robot stands. Along a bare corridor no range is to change, and nothing is said;
a scan matcher may show anything there. Turns that odometry tells of are left out: its heading is often
wrong by what would change many ranges, and wheels that turn the robot in vain are found by `check`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions, Scans
from impslam.geometry.algebra import between
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel, plain
from impslam.health import STALLED, Reasons
from impslam.tracking.reference_scan import Geometry, changed_beam, geometry_of
from impslam.types import Array, Mask

TOLD = (0.2, 0.15)
"""m, rad: motion that odometry tells of before scans are compared; ranges change by more than noise."""
SAME = (0.03, 0.005)
"""m, and share of the range: a range that changed by less is the same: 3 sigma of the noise."""
FEWEST = 10
"""Beams that have to change, or nothing is said."""
STANDS = 0.8
"""Share of them that measure the same: some see people, or edges; of a robot that moves it is near 0."""
FAR = 0.05
"""m, 1 sigma, of a robot that stands: its wheels may have shoved it."""


class Standing(NamedTuple):
    """The reference scan and the motion since; kernels change all of it in place.

    Attributes
    ----------
    ranges, points : (n,) m and (n, 2) m in base_link, of the reference scan; 0 where invalid
    told, used : (3,) motion since then, by odometry and as handed on
    stands : (2,) whether there is a reference scan, and whether the robot stands
    """

    ranges: Array
    points: Array
    told: Array
    used: Array
    stands: Mask


class Rows(NamedTuple):
    """Columns of m sweeps of n beams: points (m, n, 2) in base_link, ranges and valid (m, n)."""

    points: Array
    ranges: Array
    valid: Mask


def no_reference(beams: int) -> Standing:
    """Return what is known before the first scan of a lidar with so many beams."""
    return Standing(
        np.zeros(beams), np.zeros((beams, 2)), np.zeros(3), np.zeros(3), np.zeros(2, np.bool_)
    )


def hold(told: Array, used: Motions, scans: Scans, standing: Standing, reasons: Reasons) -> None:
    """Take back in place what was used of motions while the robot stood; give these sweeps the reason.

    `told` (m, 3) are the motions by odometry, `used` those handed on; both are of the sweeps in `scans`.
    """
    rows = Rows(plain(scans.points), plain(scans.ranges), np.ascontiguousarray(scans.valid))
    _hold(told, used, rows, geometry_of(scans), standing, reasons)


@kernel
def _hold(
    told: Array,
    used: Motions,
    rows: Rows,
    geometry: Geometry,
    standing: Standing,
    reasons: Reasons,
) -> None:
    before, origin = np.empty(3), np.zeros(3)
    for k in range(len(told)):
        before[:] = standing.used
        advance_pose(standing.told, told[k])
        advance_pose(standing.used, used.d_pose[k])
        if standing.stands[0] and not standing.stands[1]:
            way, turn = math.hypot(standing.told[0], standing.told[1]), abs(standing.told[2])
            if way < TOLD[0] and turn < TOLD[1]:
                continue
        # One that stands moves off in the direction of the newest motion.
        supposed = told[k] if standing.stands[1] else standing.told
        changed, same = _compare(rows.ranges[k], rows.valid[k], supposed, geometry, standing)
        stands = changed >= FEWEST and same >= STANDS * changed
        standing.stands[1] = standing.stands[0] and stands
        standing.told[:] = 0.0
        if standing.stands[1]:
            between(before, origin, used.d_pose[k])
            used.covariance[k] = np.outer(before, before)
            for a in range(3):
                used.covariance[k, a, a] += FAR**2
            standing.used[:] = 0.0
            reasons[k] = STALLED
        else:
            _refer(rows.points[k], rows.ranges[k], rows.valid[k], standing)


@kernel
def _refer(points: Array, ranges: Array, valid: Mask, standing: Standing) -> None:
    """Make a scan the reference."""
    standing.stands[0], standing.used[:] = True, 0.0
    standing.points[:] = points
    for i in range(len(ranges)):
        standing.ranges[i] = ranges[i] if valid[i] else 0.0


@kernel
def _compare(
    ranges: Array, valid: Mask, supposed: Array, geometry: Geometry, standing: Standing
) -> tuple[int, int]:
    """Return how many beams a motion (3,) would have changed, and how many of these are as they were.

    A shorter motion is taken for one of `TOLD` m, which tells apart what it would change.
    """
    way = math.hypot(supposed[0], supposed[1])
    scale = max(TOLD[0] / way, 1.0) if way > 0.0 else 1.0
    motion = np.array([scale * supposed[0], scale * supposed[1], 0.0])
    changed = same = 0
    for j in range(len(ranges)):
        k = changed_beam(j, motion, standing.points, standing.ranges, geometry)
        if k >= 0 and valid[k]:
            changed += 1
            same += abs(ranges[k] - standing.ranges[k]) < SAME[0] + SAME[1] * standing.ranges[k]
    return changed, same
