"""Move the beams of a sweep by a twist that scan matching finds, and find that twist.

A turn by 1 rad/s rotates the end of a sweep of 0.18 s against its beginning by 10 deg. The robot speeds up
and brakes from sweep to sweep, so the twist follows from the motion to a first match of the sweep,
de-skewed with the last velocity, and from the motion before. The motion also leads from the pose at the
middle of the sweep to that at its stamp.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from impslam.columns import Motions, Sweeps
from impslam.geometry.kernels import kernel
from impslam.noise import LEAST_UNKNOWN
from impslam.tracking.fusion import MIN_MOTION, MIN_SLIP, RATE_SIGMA, SPEED_SIGMA
from impslam.types import Array, Mask

TWIST_CHANGE = np.diag(np.square([SPEED_SIGMA, SPEED_SIGMA, RATE_SIGMA]))
"""(m/s)^2, (m/s)^2, (rad/s)^2: covariance of the change of velocity from sweep to sweep."""

MAX_TURN_RATIO = 2.0
"""Largest ratio of a turn to that of odometry: wheels that are dragged report at least half of it."""


def writable(sweeps: Sweeps) -> Sweeps:
    """Return sweeps that a tracker may de-skew in place: copies, if they need it."""
    scans = sweeps.scans
    if scans is None or scans.after is None:
        return sweeps
    points, origins = np.array(scans.points), np.array(scans.origins)
    directions = np.array(scans.directions)
    own = replace(scans, points=points, origins=origins, directions=directions)
    return replace(sweeps, scans=own)


def with_stamps(motions: Motions, sweeps: Sweeps, moved: Array) -> Sweeps:
    """Return sweeps with the motions from their middles to their stamps as the scans show them.

    `moved` (m, 3) are the tracked motions from the middle of the previous sweep to that of each. Where
    odometry turns more or less than the robot, its turns are scaled. Where it measures nothing, the
    velocity between a middle and a stamp may differ from the tracked one as much as from sweep to sweep.
    """
    scans, alone = sweeps.scans, unknown(motions.covariance)
    if scans is None or scans.after is None:
        return sweeps
    T_middle_stamp = sweeps.T_middle_stamp.copy()
    turns = motions.d_pose[:, 2]
    slipped = ~alone & (np.abs(turns) >= MIN_MOTION[1])
    slipped &= np.abs(moved[:, 2] - turns) >= MIN_SLIP[1]
    ratios = moved[slipped, 2] / turns[slipped]
    T_middle_stamp[slipped, 2] *= np.clip(ratios, 0.0, MAX_TURN_RATIO)
    span = float(np.ptp(scans.after))
    after = sweeps.columns.stamps - sweeps.middles
    after[~alone | (np.abs(after) > span)] = 0.0  # beyond: the clock was set
    share = after / np.maximum(motions.duration, span)
    covariance = sweeps.stamp_covariance.copy()
    known = (after != 0.0) & (motions.duration > 0.0)
    covariance[known] = np.square(after[known])[:, None, None] * TWIST_CHANGE
    T_middle_stamp += share[:, None] * moved
    return replace(sweeps, T_middle_stamp=T_middle_stamp, stamp_covariance=covariance)


def unknown(covariances: Array) -> Mask:
    """Return which motions are unknown, from their covariances (m, 3, 3)."""
    return np.asarray(covariances[:, 0, 0] >= LEAST_UNKNOWN)


@kernel
def set_twist(motion: Array, before: Array, seconds: float, after: Array, twist: Array) -> None:
    """Set the twist (3,) of a sweep at its middle.

    `motion` (3,) is that to its middle from the middle of the sweep before, in `seconds`, and `before` (3,)
    the one to that. The mean velocity over an interval is that at its centre, half an interval earlier, so
    half of its last change is added. `after` (n,) s are the times of the beams after the middle. No sweep
    takes longer than the time between sweeps; stamps that say so are wrong.
    """
    first = last = 0.0
    for t in after:
        first, last = min(first, t), max(last, t)
    twist[:] = (1.5 * motion - 0.5 * before) / max(seconds, last - first, 1e-3)


@kernel
def deskew(parts: tuple[Array, Array, Array, Array], twist: Array, known: Array) -> None:
    """Move the beams of a sweep to its middle in place, with a twist (3,) instead of the `known` one.

    `parts` are the end points (n, 2), origins (n, 2) and directions (n,) of the beams, and their times (n,)
    after the middle. A chord at half of the turn stands for each arc.
    """
    points, origins, directions, after = parts
    for i in range(len(after)):
        t = after[i]
        old, new = known[2] * t, twist[2] * t
        c, s = math.cos(0.5 * old), math.sin(0.5 * old)
        from_x, from_y = t * (c * known[0] - s * known[1]), t * (s * known[0] + c * known[1])
        c, s = math.cos(0.5 * new), math.sin(0.5 * new)
        to_x, to_y = t * (c * twist[0] - s * twist[1]), t * (s * twist[0] + c * twist[1])
        c, s = math.cos(new - old), math.sin(new - old)
        directions[i] += new - old
        for ends in (points, origins):
            x, y = ends[i, 0] - from_x, ends[i, 1] - from_y
            ends[i, 0], ends[i, 1] = to_x + c * x - s * y, to_y + s * x + c * y
