"""Learn the bias and noise of odometry from scan matching while the robot drives.

The bias (turn per metre, scale errors of turn and distance) is a recursive least-squares estimate that
forgets over ten metres. The noise is the mean square error over segments of two metres. Wheels wear,
floors differ, and one noise model does not fit two robots (Roy and Thrun 1999 learn the bias similarly).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.types import Array

SEGMENT_LENGTH = 2.0
"""m (a radian counts as one): long compared with the error of matching, 1 to 2 cm."""
BIAS_MEMORY = 10.0
"""m over which the bias is averaged: tens of matches, one kind of floor."""
NOISE_RATE = 0.1
"""Least weight of the newest segment in the noise: the mean of about ten segments, 20 m. The first segments
have the same weight as `START`: robots differ tenfold."""
START = np.array([0.08, 0.05])
"""m/sqrt(m) and rad/sqrt(m), the noise before the first segment: that of indoor robots."""
MIN_NOISE = np.array([0.003, 0.0005])
"""m/sqrt(m) and rad/sqrt(m): lower bound of the noise; no wheel is better."""
UNLOCATED_NOISE = np.array([np.inf, 0.03])
"""m/sqrt(m) and rad/sqrt(m): the noise falls below only if matches determine the position and the heading.
Wheels are seldom better. Outdoors scans may say little for minutes, and larger values let them mislead."""
MATCH_SIGMA = (0.014, 0.004)
"""m, rad: error of two matches; only the excess is attributed to odometry."""
MAX_BIAS = np.array([0.2, 0.2, 0.1])
"""rad/m, 1, 1: beyond, something else is wrong."""
BIAS_PRIOR = 0.1
"""m^2 or rad^2: sum of squared motions that the prior, no bias, counts for. A few matches outweigh it."""
POSITION_LEVER, HEADING_LEVER = 0.3, 0.5
"""m/rad: a turn adds as much noise to the position and to the heading as this distance."""
STATIONARY_DISTANCE = 0.1
"""m added to every distance, since a stationary robot may have been pushed."""
MIN_SIGMA = (0.002, 0.0007)
"""m, rad: standard deviations added to those of every motion."""
MAX_GROWTH, CLIPPED_MEAN = 4.0, 0.92
"""Multiple of the noise at which that of a segment is clipped, since it may be a slip; and the mean of a
chi-square with one degree of freedom that is clipped there."""


class LearnedOdometry(NamedTuple):
    """Bias and noise of odometry, and the current segment; kernels change all of it in place.

    Attributes
    ----------
    bias : (3,) rad/m turn per distance, and scale errors of turn and distance
    sums : (3, 2) of the least squares for each bias
    noise : (2,) variance of position, m^2/m, and of heading, rad^2/m
    odometry : (3,) odometry's motion since the segment began, corrected by the bias
    lengths : (4,) m and rad of that motion, and the numbers of matches that did not determine the position
        and the heading
    begin : (3,) matched pose at which the segment began
    segments : (1,) number of those before
    """

    bias: Array
    sums: Array
    noise: Array
    odometry: Array
    lengths: Array
    begin: Array
    segments: Array


def initial_odometry() -> LearnedOdometry:
    """Return the state before anything is learned."""
    zeros = (np.zeros(3) for _ in range(3))
    return LearnedOdometry(
        next(zeros), np.zeros((3, 2)), START**2, next(zeros), np.zeros(4), next(zeros), np.zeros(1)
    )


@kernel
def correct(learned: LearnedOdometry, d_pose: Array) -> None:
    """Remove the bias from a motion (3,) of odometry in place, and add it to the segment."""
    bias = learned.bias
    d_pose[2] += bias[0] * d_pose[0] + bias[1] * d_pose[2]
    d_pose[0] *= 1.0 + bias[2]
    d_pose[1] *= 1.0 + bias[2]
    advance_pose(learned.odometry, d_pose)
    learned.lengths[0] += math.hypot(d_pose[0], d_pose[1])
    learned.lengths[1] += abs(d_pose[2])


@kernel
def variances(learned: LearnedOdometry, distance: float, turn: float) -> tuple[float, float]:
    """Return the variances of position, m^2 along each axis, and of heading, rad^2, after a motion.

    The noise of `STATIONARY_DISTANCE` and `MIN_SIGMA` is always included.
    """
    return (
        learned.noise[0] * (distance + POSITION_LEVER * turn + STATIONARY_DISTANCE)
        + MIN_SIGMA[0] ** 2,
        learned.noise[1] * (distance + HEADING_LEVER * turn + STATIONARY_DISTANCE)
        + MIN_SIGMA[1] ** 2,
    )


@kernel
def learn(
    learned: LearnedOdometry,
    motion: Array,
    off: Array,
    plausible: bool,
    pose: Array,
    quality: float,
    located: tuple[bool, bool],
) -> None:
    """Update with a match: odometry's motion (3,) since the last match, and its error `off` (3,).

    Only plausible matches contribute to the bias. `pose` is as matched; `quality`, in 0..1, is how much it
    can be trusted. `located` is whether it determines the position and the heading: if not, as along a bare
    corridor or with few beams, they are those of odometry, and that both agree means nothing. The noise
    then hardly falls, and the scale of distance is not learned.
    """
    learned.lengths[2] += not located[0]
    learned.lengths[3] += not located[1]
    if plausible:
        _learn_bias(learned, motion, off, located[0])
    if learned.lengths[0] + learned.lengths[1] >= SEGMENT_LENGTH:
        _learn_noise(learned, pose, quality)
        learned.begin[:] = pose
        learned.odometry[:] = 0.0
        learned.lengths[:] = 0.0


@kernel
def _learn_bias(learned: LearnedOdometry, motion: Array, off: Array, with_distance: bool) -> None:
    """Update the bias with a match; see `learn`."""
    keep = math.exp(-(abs(motion[0]) + POSITION_LEVER * abs(motion[2])) / BIAS_MEMORY)
    for k in range(3 if with_distance else 2):
        cause, effect = (motion[2] if k == 1 else motion[0]), (off[0] if k == 2 else off[2])
        whole = effect + learned.bias[k] * cause  # without the correction
        learned.sums[k, 0] = keep * learned.sums[k, 0] + cause * whole
        learned.sums[k, 1] = keep * learned.sums[k, 1] + cause * cause
        bias = learned.sums[k, 0] / (learned.sums[k, 1] + BIAS_PRIOR)
        learned.bias[k] = min(max(bias, -MAX_BIAS[k]), MAX_BIAS[k])


@kernel
def _learn_noise(learned: LearnedOdometry, pose: Array, quality: float) -> None:
    """Update the noise with a segment that ends at a matched pose (3,)."""
    matched = np.empty(3)
    between(learned.begin, pose, matched)
    distance, turn = learned.lengths[0], learned.lengths[1]
    ex, ey = matched[0] - learned.odometry[0], matched[1] - learned.odometry[1]
    et = wrap_in_kernel(matched[2] - learned.odometry[2])
    excess = 0.5 * (ex * ex + ey * ey) - MATCH_SIGMA[0] ** 2, et * et - MATCH_SIGMA[1] ** 2
    measured = (
        max(excess[0], 0.0) / (distance + POSITION_LEVER * turn),
        max(excess[1], 0.0) / (distance + HEADING_LEVER * turn),
    )
    learned.segments[0] += 1.0
    rate = quality * max(NOISE_RATE, 1.0 / (learned.segments[0] + 1.0))
    for k in range(2):
        new = min(measured[k], MAX_GROWTH * learned.noise[k]) / CLIPPED_MEAN
        if learned.lengths[2 + k] > 0.0:
            new = max(new, min(learned.noise[k], UNLOCATED_NOISE[k] ** 2))
        learned.noise[k] += rate * (new - learned.noise[k])
        learned.noise[k] = max(learned.noise[k], MIN_NOISE[k] ** 2)
