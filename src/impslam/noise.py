"""Noise of a wheeled robot's dead reckoning: variances that grow with the distance travelled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.parameters import Parameters, parameter
from impslam.types import Array, Mask

UNKNOWN = 1e6
"""m^2: variance of an unknown motion, as for a robot without odometry."""

LEAST_UNKNOWN = 0.5 * UNKNOWN
"""m^2: variance from which on a motion is unknown; that of one is rounded if it is cut and composed."""

MAX_GAP = 3.0
"""s between two readings or two sweeps; after a longer gap the robot's path is unknown."""

MIN_BREAK = 600.0
"""s; a longer gap is likely to be that between two drives. The robot may have been carried meanwhile, and
its odometry may begin at 0 again, so that a jump may be no motion. If it stands still, it has gone on."""

BIAS_CORRELATION_TIME = 20.0
"""s; where the error of a gyro's bias is taken as random, the variance of the turn grows per second as if
it were independent after each such time. It lasts longer, but scans correct the heading sooner."""


class SystematicErrors(NamedTuple):
    """Standard deviations of constant errors of odometry's turns.

    Attributes
    ----------
    turn_per_distance : rad/m, wheels of unequal radius (Borenstein & Feng 1996)
    turn : relative, a wrong track
    gyro_scale : relative, the scale of the gyro
    gyro_bias : rad/s, the bias of the gyro, which changes slowly; 0 without a gyro
    gyro_share : share of the gyro in the turns; that of the wheels is the rest
    """

    turn_per_distance: float
    turn: float
    gyro_scale: float = 0.0
    gyro_bias: float = 0.0
    gyro_share: float = 0.0

    def errors(self, d_pose: Array, duration: Array | float = 0.0) -> Array:
        """Return the errors (..., 3, k) of motions (..., 3) of `duration` (...) s.

        There is a column per standard deviation of each error: two of the wheels, two of a gyro if there is
        one. For arcs, to first order in the turn: an error of the turn acts, on average, halfway.
        """
        x, y, turn = np.moveaxis(d_pose, -1, 0)
        wheels, gyro = 1.0 - self.gyro_share, self.gyro_share
        by_motion = np.stack([-0.5 * y, 0.5 * x, np.ones_like(x)], -1)
        of_turn = [wheels * self.turn_per_distance * x, wheels * self.turn * turn]
        if self.gyro_bias:
            of_turn += [gyro * self.gyro_scale * turn, gyro * self.gyro_bias * duration + 0.0 * x]
        return np.asarray(by_motion[..., :, None] * np.stack(of_turn, -1)[..., None, :])

    @property
    def learned(self) -> Mask:
        """Which errors (k,) landmarks determine: those of the gyro, which are the same in each motion.

        Wheels also slip differently in each turn, so no value of theirs would be right.
        """
        return np.array([False, False, True, True] if self.gyro_bias else [False, False])

    def turn_variances(self, d_pose: Array, duration: Array | float = 0.0) -> Array:
        """Return the variances (...) of turns in motions (..., 3), if the errors were independent.

        They are the same as those of the constant errors at 1 m or 1 rad, and `BIAS_CORRELATION_TIME`.
        """
        distance, turn = np.hypot(d_pose[..., 0], d_pose[..., 1]), np.abs(d_pose[..., 2])
        wheels = self.turn_per_distance**2 * distance + self.turn**2 * turn
        lasting = np.maximum(BIAS_CORRELATION_TIME, duration)
        gyro = self.gyro_scale**2 * turn + self.gyro_bias**2 * duration * lasting
        return np.asarray((1.0 - self.gyro_share) ** 2 * wheels + self.gyro_share**2 * gyro)

    def correlation(self, before: SystematicErrors) -> Array:
        """Return the correlation (k,) of each error with the same one before.

        The error of the bias changes in two ways. As a random walk, it gets an independent part, so that
        the correlation is the ratio of the standard deviations before and after. If the bias is measured,
        its error becomes (1 - K) e + K v with the variance (1 - K) E[e^2], and the correlation is the
        inverse of that ratio.
        """
        if not self.gyro_bias:
            return np.ones(2)
        low, high = sorted((self.gyro_bias, before.gyro_bias))
        return np.array([1.0, 1.0, 1.0, low / high])


class MotionNoise(Parameters):
    """Random walk of dead reckoning (after Thrun et al. 2005, ch. 5.4, as variances per distance).

    Variances are proportional to the distance and the angle travelled, so that they do not depend on
    how a path is cut into increments. The defaults are from measured relations between poses of
    indoor robots with wheel odometry: 0.05 rad/sqrt(m) straight on, 0.09 to 0.14 rad/sqrt(rad) in turns.
    """

    forward: float = parameter(
        0.05, "m/sqrt(m)", "error along the path, per root metre", ge=0, noise=True
    )
    sideways: float = parameter(
        0.03, "m/sqrt(m)", "error across the path, per root metre", ge=0, noise=True
    )
    turn_per_distance: float = parameter(
        0.05, "rad/sqrt(m)", "heading error of driving, per root metre", ge=0, noise=True
    )
    turn_per_turn: float = parameter(
        0.15, "rad/sqrt(rad)", "heading error of turning (slip), per root radian", ge=0, noise=True
    )

    systematic: float = parameter(
        0.0,
        "1",
        "share of the turns' variances that is due to constant errors, such as that of the track. Filters "
        "that consider them (Schmidt) let their standard deviation grow with the motion instead of its "
        "root; it is the same at 1 m or 1 rad",
        ge=0,
        le=1,
    )

    def split(self) -> tuple[MotionNoise, SystematicErrors]:
        """Return the noise without systematic errors, and these."""
        rest, factor = math.sqrt(1.0 - self.systematic), math.sqrt(self.systematic)
        turning = {"turn_per_distance": self.turn_per_distance, "turn_per_turn": self.turn_per_turn}
        update = {name: rest * sigma for name, sigma in turning.items()} | {"systematic": 0.0}
        errors = SystematicErrors(factor * self.turn_per_distance, factor * self.turn_per_turn)
        return self.model_copy(update=update), errors

    def variances(self, distances: Array, angles: Array) -> Array:
        """Return variances (m, 3) along, across and of the heading for motions over (m,) m and (m,) rad."""
        distance, turn = np.abs(distances), np.abs(angles)
        out = np.empty((len(distance), 3))
        out[:, 0] = self.forward**2 * distance
        out[:, 1] = self.sideways**2 * distance
        out[:, 2] = self.turn_per_distance**2 * distance + self.turn_per_turn**2 * turn
        return out

    def covariance(self, distance: float, angle: float) -> Array:
        """Return the covariance (3, 3) of a motion by `distance` m and `angle` rad, in the body frame."""
        (variances,) = self.variances(np.array([distance]), np.array([angle]))
        return np.diag(variances)
