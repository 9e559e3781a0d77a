"""What odometry is worth, learned from the scans while the robot drives.

Its bias (turn per metre, scale of turns and of ways) is a recursive least squares estimate that forgets
over ten metres; its noise is the mean square of what it was off by over segments of two metres. Wheels
wear, floors differ, and one model of noise fits no two robots (Roy and Thrun 1999 learn the bias alike).
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

SEGMENT = 2.0
"""m (a radian counts as one): long against the error of matching, 1 to 2 cm."""
FORGET = 10.0
"""m over which the bias is averaged: tens of matches, one kind of floor."""
RATE = 0.1
"""Weight of the newest segment in the noise: the mean of about ten segments, 20 m."""
START = np.array([0.08, 0.05])
"""m/sqrt(m) and rad/sqrt(m), the noise before the first segment: that of indoor robots."""
LEAST = np.array([0.003, 0.0005])
"""m/sqrt(m) and rad/sqrt(m): no wheel is better."""
MATCHING = (0.014, 0.004)
"""m, rad: what two matches are off by themselves; only what is beyond it is odometry's."""
MOST_BIAS = np.array([0.2, 0.2, 0.1])
"""rad/m, 1, 1: beyond, something else is wrong."""


class LearnedOdometry(NamedTuple):
    """Bias and noise of odometry, and the segment that runs; kernels change all of it in place.

    Attributes
    ----------
    bias : (3,) rad/m turn per way, and scale errors of turn and of way
    sums : (3, 2) of the least squares for each bias
    noise : (2,) variance of the way, m^2/m, and of the heading, rad^2/m
    told : (3,) odometry's motion since the segment began, corrected by the bias
    lengths : (3,) m and rad that are in it, and the number of matches that left the position open
    begin : (3,) matched pose at which it began
    """

    bias: Array
    sums: Array
    noise: Array
    told: Array
    lengths: Array
    begin: Array


def unlearned() -> LearnedOdometry:
    """Return what is assumed before anything is learned."""
    zeros = (np.zeros(3) for _ in range(3))
    return LearnedOdometry(
        next(zeros), np.zeros((3, 2)), START**2, next(zeros), np.zeros(3), next(zeros)
    )


@kernel
def correct(learned: LearnedOdometry, d_pose: Array) -> None:
    """Take the bias from a motion (3,) of odometry in place, and let the segment go on."""
    bias = learned.bias
    d_pose[2] += bias[0] * d_pose[0] + bias[1] * d_pose[2]
    d_pose[0] *= 1.0 + bias[2]
    d_pose[1] *= 1.0 + bias[2]
    advance_pose(learned.told, d_pose)
    learned.lengths[0] += math.hypot(d_pose[0], d_pose[1])
    learned.lengths[1] += abs(d_pose[2])


@kernel
def variances(learned: LearnedOdometry, way: float, turn: float) -> tuple[float, float]:
    """Return the variances of position, m^2 along each axis, and of heading, rad^2, after a motion.

    A robot that stands may have been pushed: 0.1 m of way, 2 mm and 0.7 mrad are always possible.
    """
    return (
        learned.noise[0] * (way + 0.3 * turn + 0.1) + 0.002**2,
        learned.noise[1] * (way + 0.5 * turn + 0.1) + 0.0007**2,
    )


@kernel
def learn(
    learned: LearnedOdometry,
    motion: Array,
    off: Array,
    plausible: bool,
    pose: Array,
    quality: float,
    located: bool,
) -> None:
    """Take in a match: odometry's motion (3,) since the last one, and what it was off by, (3,).

    Only plausible matches tell of the bias. `pose` is as matched; `quality`, in 0..1, is how far it is
    to be trusted. Where matches leave the position open, as along a bare corridor, it is odometry's own:
    that both agree tells nothing then, and the noise of the way does not fall.
    """
    learned.lengths[2] += not located
    if plausible:
        keep = math.exp(-(abs(motion[0]) + 0.3 * abs(motion[2])) / FORGET)
        for k in range(3):
            cause, effect = (motion[2] if k == 1 else motion[0]), (off[0] if k == 2 else off[2])
            learned.sums[k, 0] = keep * learned.sums[k, 0] + cause * (
                effect + learned.bias[k] * cause
            )
            learned.sums[k, 1] = keep * learned.sums[k, 1] + cause * cause
            found = learned.sums[k, 0] / (learned.sums[k, 1] + 0.1)
            learned.bias[k] = min(max(found, -MOST_BIAS[k]), MOST_BIAS[k])
    if learned.lengths[0] + learned.lengths[1] < SEGMENT:
        return
    shown = np.empty(3)
    between(learned.begin, pose, shown)
    way, turn = learned.lengths[0], learned.lengths[1]
    ex, ey = shown[0] - learned.told[0], shown[1] - learned.told[1]
    et = wrap_in_kernel(shown[2] - learned.told[2])
    excess = 0.5 * (ex * ex + ey * ey) - MATCHING[0] ** 2, et * et - MATCHING[1] ** 2
    seen = max(excess[0], 0.0) / (way + 0.3 * turn), max(excess[1], 0.0) / (way + 0.5 * turn)
    for k in range(2):
        new = min(seen[k], 4.0 * learned.noise[k]) / 0.92
        if k == 0 and learned.lengths[2] > 0.0:
            new = max(new, learned.noise[0])
        learned.noise[k] += RATE * quality * (new - learned.noise[k])
        learned.noise[k] = max(learned.noise[k], LEAST[k] ** 2)
    learned.begin[:] = pose
    learned.told[:] = 0.0
    learned.lengths[:] = 0.0
