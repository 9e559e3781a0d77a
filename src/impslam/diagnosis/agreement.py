"""Linear relation between odometry and the motion measured by the laser.

Let F and T be the forward distance and the turn of the axle over a stretch, measured by the laser, and S
and R the same by odometry. If the config is correct, S = F and R = T. In general

    S = a F + b T,    R = c F + d T

with a the distance scale, d the turn scale, c the turn per metre (unequal wheels), and b the laser's offset
to the left times a. An axle does not move sideways, so the laser's motion alone gives the driving direction
in the laser's frame, and how far the laser is ahead of the axle (Censi et al. 2013 solve for both with
odometry):

    n . [u, v] = x T,    n a unit vector, x the distance of the laser ahead of the axle.

Robots that move sideways have no such axle. Then odometry gives the direction ahead and the position of
the laser:

    [S, Q] = s M [u, v] + T [y, -x]

with Q the sideways motion by odometry, M the rotation from the laser's frame to base_link, s the distance
scale, and (x, y) the position of the laser in base_link.

F and T have errors too. If the robot hardly turns, T is little else, and so is every factor on it. If all
stretches are arcs of one radius, F - r T is little else. The standard deviations allow for both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.diagnosis.lag import MATCH_ERROR
from impslam.diagnosis.robust import CLEAR, RobustFit, biweight, fit, robust_sigma, sandwich
from impslam.types import Array

MIN_STRETCHES = 12
"""Stretches that a fit needs: twice the rows that its robust scale can be wrong about."""
ROUNDING = math.sqrt(6.0)
"""Resolution over the standard deviation of the difference of two rounded values."""
MIN_SCALE = 0.02
"""Share of the laser's motion below which the sign of odometry's is chance: it creeps while it stands."""
MATCH_DISTANCE_ERROR = 0.004
"""m: error of a match, a hundredth of a stretch."""
REACH = 10.0
"""m: how far a lidar sees in a large room. A match that is off by an angle may be off sideways by that
times the angle, which looks like a laser so far from the axle."""


class Axis(NamedTuple):
    """The driving direction of the robot, in the laser's frame.

    Attributes
    ----------
    angle : rad, the beam angle that points ahead; motion alone leaves its sense open, see `drive_axis`
    ahead : m, position of the laser in that direction, relative to the axle, or to base_link without one
    covariance : (2, 2) of both
    inliers : share of stretches that fit
    has_axle : False if odometry reports that the robot moves sideways
    """

    angle: float
    ahead: float
    covariance: Array
    inliers: float
    has_axle: bool = True

    def flipped(self) -> Axis:
        """Return the same axis with the opposite sense."""
        return self._replace(angle=self.angle + math.pi, ahead=-self.ahead)


def drive_axis(motions: Array) -> Axis:
    """Estimate the axis from the laser's motions over k stretches, (k, 3) m, m, rad.

    Its angle is in [-pi/2, pi/2).
    """
    distance, turn = motions[:, :2], motions[:, 2]
    weights = np.ones(len(motions))
    for _ in range(30):
        lever = (weights * turn) @ distance / (float((weights * turn) @ turn) + 1e-12)
        rest = distance - np.outer(turn, lever)
        _, axes = np.linalg.eigh((rest * weights[:, None]).T @ rest)
        normal = axes[:, 0] * (-1.0 if axes[1, 0] < 0.0 else 1.0)
        residuals = rest @ normal
        scale = robust_sigma(residuals)
        weights = biweight(residuals, scale)
    forward = np.array([normal[1], -normal[0]])
    covariance = sandwich(np.column_stack((-distance @ forward, -turn)), residuals, scale)
    covariance[1, 1] += (REACH * _noise_share(turn, weights)) ** 2
    along = _attenuation(np.column_stack((distance @ forward, turn)), weights)[:, 0]
    covariance += np.outer(along, along)
    return Axis(
        math.atan2(forward[1], forward[0]),
        float(normal @ lever),
        covariance,
        float((weights > 0.0).mean()),
    )


def axis_by_odometry(motions: Array, odometry: Array) -> Axis:
    """Estimate the axis of a robot that moves sideways, from motions over k stretches, (k, 3) m, m, rad.

    `motions` of the laser are compared with those of base_link by odometry, so the sense is known.
    """
    u, v, turn = motions.T
    none = np.zeros_like(turn)
    A = np.concatenate((np.column_stack((u, v, turn, none)), np.column_stack((v, -u, none, -turn))))
    moved = np.concatenate((odometry[:, 0], odometry[:, 1]))
    found = fit(A, moved)
    a, b, _, x = found.p
    scale = math.hypot(a, b) + 1e-12
    J = np.zeros((2, 4))
    J[0, :2] = -b / scale**2, a / scale**2
    J[1, :2], J[1, 3] = -x / scale**3 * found.p[:2], 1.0 / scale
    residuals = moved - A @ found.p
    weights = biweight(residuals, robust_sigma(residuals))
    return Axis(
        math.atan2(b, a),
        x / scale,
        J @ found.covariance @ J.T,
        float((weights > 0.0).mean()),
        False,
    )


class Agreement(NamedTuple):
    """The fits of S (parameters [a, b]) and R (parameters [c, d])."""

    distance: RobustFit
    turn: RobustFit

    @property
    def opposes_distance(self) -> bool:
        """Whether distances have opposite signs."""
        return self.distance.is_negative(0) and self.distance.p[0] < -MIN_SCALE

    @property
    def opposes_turn(self) -> bool:
        """Whether turns have opposite signs."""
        return self.turn.is_negative(1) and self.turn.p[1] < -MIN_SCALE

    @property
    def is_alike(self) -> bool:
        """Whether distances and turns clearly have the same signs."""
        scales = (self.distance.p[0], self.distance.sigma[0]), (self.turn.p[1], self.turn.sigma[1])
        return all(scale > max(CLEAR * sigma, MIN_SCALE) for scale, sigma in scales)

    @property
    def is_reversed(self) -> bool:
        """Whether distances have opposite signs and turns do not."""
        return self.opposes_distance and not self.opposes_turn

    @property
    def is_noise(self) -> bool:
        """Whether odometry hardly moves, and not with the laser: no unit of its readings explains that."""
        scales = float(self.distance.p[0]), float(self.turn.p[1])
        return min(scales) <= 0.0 and max(map(abs, scales)) < MIN_SCALE


def fit_agreement(
    axle: Array, odometry: Array, resolution: Sequence[float] | Array = (0.0, 0.0, 0.0)
) -> Agreement:
    """Fit odometry's motions (k, 3) to the laser's motions of the axle (k, 2), m and rad.

    `resolution` (3,) is that of odometry: if most turns of a straight drive are rounded to 0, the others
    are no outliers.
    """
    distance, turn = (
        fit(axle, odometry[:, k], min_sigma=float(resolution[k]) / ROUNDING) for k in (0, 2)
    )
    weights = np.ones(len(axle))
    by_distance, by_turn = _attenuation(axle, weights).T
    distance.covariance[1, 1] += (REACH * _noise_share(axle[:, 1], weights)) ** 2
    distance.covariance[:] += max(abs(distance.p[0]), 1.0) ** 2 * np.outer(by_distance, by_distance)
    turn.covariance[:] += max(abs(turn.p[1]), 1.0) ** 2 * np.outer(by_turn, by_turn)
    return Agreement(distance, turn)


def _attenuation(motions: Array, weights: Array) -> Array:
    """Return how far errors of matched motions (k, 2), m and rad, move the factors on them, (2, 2).

    Column j is the change of both factors if the true ones are 1 on column j of the motions and 0 on the
    other one (errors in variables; Fuller 1987): the first factor falls, the second one takes its part.
    """
    squares = (motions * weights[:, None]).T @ motions + 1e-12 * np.eye(2)
    errors = float(weights.sum()) * np.square([MATCH_DISTANCE_ERROR, MATCH_ERROR])
    moved: Array = -np.linalg.inv(squares) * errors
    return moved


def _noise_share(turns: Array, weights: Array) -> float:
    """Return the share of errors in the squares of matched turns (k,)."""
    return MATCH_ERROR**2 * float(weights.sum()) / (float((weights * turns) @ turns) + 1e-12)
