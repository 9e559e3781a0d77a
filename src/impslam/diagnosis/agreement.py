"""How odometry agrees with the laser's own motion.

With F and T the way forward and the turn of the axle by the laser, and S and R those by odometry, each of a
stretch, a robot that is as its config says has S = F and R = T. In general

    S = a F + b T,    R = c F + d T

with a the scale of ways, d that of turns, c the turn per metre (unequal wheels), b the laser's offset
to the left times a. An axle does not move sideways, and so the laser's motion alone tells along which of
its axes the robot drives, and how far ahead of the axle it stands (Censi et al. 2013 solve for both with
odometry):

    n . [u, v] = x T,    n a unit vector, x how far the laser stands ahead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.diagnosis.robust import Fit, biweight, fit, sandwich, spread
from impslam.types import Array

FEWEST = 12
"""Stretches of a fit at least: twice the rows that its robust scale can be wrong about."""


class Axis(NamedTuple):
    """The direction in which the robot drives, seen from the laser.

    Attributes
    ----------
    angle : rad, the beam angle that looks ahead, in [-pi/2, pi/2): a motion cannot tell ahead from astern
    ahead : m, how far the laser stands in that direction from the axle
    covariance : (2, 2) of both
    inliers : share of stretches that fit
    """

    angle: float
    ahead: float
    covariance: Array
    inliers: float

    def turned(self) -> Axis:
        """Return the axis in the other sense."""
        return self._replace(angle=self.angle + math.pi, ahead=-self.ahead)


def drive_axis(laser: Array) -> Axis:
    """Find the axis from the laser's motions over k stretches, (k, 3) m, m, rad."""
    way, turn = laser[:, :2], laser[:, 2]
    weights = np.ones(len(laser))
    for _ in range(30):
        lever = (weights * turn) @ way / (float((weights * turn) @ turn) + 1e-12)
        rest = way - np.outer(turn, lever)
        _, axes = np.linalg.eigh((rest * weights[:, None]).T @ rest)
        normal = axes[:, 0] * (-1.0 if axes[1, 0] < 0.0 else 1.0)
        residuals = rest @ normal
        scale = spread(residuals)
        weights = biweight(residuals, scale)
    forward = np.array([normal[1], -normal[0]])
    J = np.column_stack((-way @ forward, -turn))
    return Axis(
        math.atan2(forward[1], forward[0]),
        float(normal @ lever),
        sandwich(J, residuals, scale),
        float((weights > 0.0).mean()),
    )


class Agreement(NamedTuple):
    """The fits of S and R; parameters are [a, b] and [c, d]."""

    way: Fit
    turn: Fit

    @property
    def is_astern(self) -> bool:
        """Whether ways are opposite, and turns are not."""
        return self.way.is_negative(0) and not self.turn.is_negative(1)


def agreement(axle: Array, odometry: Array) -> Agreement:
    """Relate odometry (k, 3) to the motion of the axle (k, 2), m and rad, by the laser."""
    return Agreement(fit(axle, odometry[:, 0]), fit(axle, odometry[:, 2]))
