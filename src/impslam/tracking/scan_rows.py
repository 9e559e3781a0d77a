"""What the rows of a lidar say of it: whether it repeats a scan, and whether its clock runs on.

No two sweeps of a working lidar are alike to the bit while the robot moves, but a driver or a network that
hangs sends the last one again. Such a scan would hold the robot where it is. A clock that runs back and
forth makes motion unknown, since it is taken between stamps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import DISORDERED, REPEATED, Reasons
from impslam.types import Array, Mask

MOVED = (0.1, 0.05)
"""m, rad: motion by odometry after which ranges differ by more than their resolution, 1 cm."""
MEMORY = 0.1
"""Weight of the newest scan in the share of those whose stamp is earlier than the one before: 10 scans."""
DISORDER = 0.3
"""Share above which the clock is not to be trusted. A busy computer's stamps run back in 5 % of the scans,
and in three of ten by chance in one of a thousand."""


class Rows(NamedTuple):
    """The newest row of one lidar; changed in place.

    Attributes
    ----------
    ranges : (n,) m
    state : (4,) m and rad by odometry since the first of rows that are alike; the stamp; and the
        share of earlier stamps
    """

    ranges: Array
    state: Array


def first_row(beams: int) -> Rows:
    """Return what is known before the first row of a lidar with so many beams."""
    return Rows(np.zeros(beams), np.array([0.0, 0.0, -np.inf, 0.0]))


def judge_rows(stamps: Array, ranges: Array, d_pose: Array, known: Rows) -> Reasons:
    """Return what is wrong with the rows (m,) of a lidar.

    `stamps` (m,) are the log's own, `ranges` (m, n) in m, and `d_pose` (m, 3) is by odometry, before each.
    """
    before = np.concatenate((known.ranges[None], ranges[:-1]))
    bits = np.ascontiguousarray(ranges).view(np.int64)
    alike = (before.view(np.int64) == bits).all(axis=1)
    reasons = np.zeros(len(stamps), np.int8)
    if len(stamps):
        _judge(stamps, d_pose, alike, known.state, reasons)
        known.ranges[:] = ranges[-1]
    return reasons


@kernel
def _judge(stamps: Array, d_pose: Array, alike: Mask, state: Array, reasons: Reasons) -> None:
    for k in range(len(stamps)):
        back = 1.0 if stamps[k] < state[2] else 0.0
        state[2] = stamps[k]
        state[3] += MEMORY * (back - state[3])
        if state[3] > DISORDER:
            reasons[k] = DISORDERED
        if not alike[k]:
            state[0] = state[1] = 0.0
            continue
        state[0] += math.hypot(d_pose[k, 0], d_pose[k, 1])
        state[1] += abs(d_pose[k, 2])
        if state[0] > MOVED[0] or state[1] > MOVED[1]:
            reasons[k] = REPEATED
