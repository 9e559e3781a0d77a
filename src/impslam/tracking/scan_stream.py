"""Detect repeated scans and disordered stamps in the stream of a lidar.

No two sweeps of a working lidar are equal bit for bit while the robot moves, but a driver or a network that
hangs sends the last one again. Such a scan would hold the estimated pose back. With a clock that runs back
and forth the motion is unknown, since it is computed between stamps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import DISORDERED, REPEATED, Reasons
from impslam.types import Array, Mask

MIN_MOTION = (0.1, 0.05)
"""m, rad: motion by odometry after which ranges differ by more than their resolution, 1 cm."""
MEMORY = 0.1
"""Weight of the newest scan in the share of stamps that are earlier than the one before: 10 scans."""
MAX_DISORDER = 0.3
"""Share above which the clock cannot be trusted. A busy computer's stamps run back in 5 % of the scans,
and three of ten do so by chance in one case of a thousand."""


class StreamState(NamedTuple):
    """The newest scan of one lidar; changed in place.

    Attributes
    ----------
    ranges : (n,) m
    moved : (2,) m and rad by odometry since the first of equal scans
    stamp : (1,) s
    disorder : (1,) share of stamps that run back
    """

    ranges: Array
    moved: Array
    stamp: Array
    disorder: Array


def initial_stream_state(beams: int) -> StreamState:
    """Return the state before the first scan of a lidar with this number of beams."""
    return StreamState(np.zeros(beams), np.zeros(2), np.full(1, -np.inf), np.zeros(1))


def check_stream(stamps: Array, ranges: Array, d_pose: Array, last: StreamState) -> Reasons:
    """Return what is wrong with the next scans (m,) of a lidar.

    `stamps` (m,) are those of the log, `ranges` (m, n) in m, and `d_pose` (m, 3) is by odometry, before
    each.
    """
    before = np.concatenate((last.ranges[None], ranges[:-1]))
    bits = np.ascontiguousarray(ranges).view(np.int64)
    equal = (before.view(np.int64) == bits).all(axis=1)
    reasons = np.zeros(len(stamps), np.int8)
    if len(stamps):
        _check(stamps, d_pose, equal, last, reasons)
        last.ranges[:] = ranges[-1]
    return reasons


@kernel
def _check(stamps: Array, d_pose: Array, equal: Mask, last: StreamState, reasons: Reasons) -> None:
    """Fill the reasons (m,) of scans, given which of them are equal to the one before (m,)."""
    moved, stamp, disorder = last.moved, last.stamp, last.disorder
    for k in range(len(stamps)):
        back = 1.0 if stamps[k] < stamp[0] else 0.0
        stamp[0] = stamps[k]
        disorder[0] += MEMORY * (back - disorder[0])
        if disorder[0] > MAX_DISORDER:
            reasons[k] = DISORDERED
        if not equal[k]:
            moved[:] = 0.0
            continue
        moved[0] += math.hypot(d_pose[k, 0], d_pose[k, 1])
        moved[1] += abs(d_pose[k, 2])
        if moved[0] > MIN_MOTION[0] or moved[1] > MIN_MOTION[1]:
            reasons[k] = REPEATED
