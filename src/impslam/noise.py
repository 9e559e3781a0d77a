"""How far a wheeled robot's dead reckoning strays: variances that grow with the way it goes."""

from __future__ import annotations

import numpy as np

from impslam.parameters import Parameters, parameter
from impslam.types import Array

UNKNOWN = 1e6
"""m^2: motions with such a variance tell nothing; a robot without odometry has none other."""

MAX_GAP = 3.0
"""s between two readings or two sweeps, beyond which nobody knows by which path the robot has gone."""


class MotionNoise(Parameters):
    """Random walk of dead reckoning (after Thrun et al. 2005, ch. 5.4, as variances per way).

    Variances are proportional to the distance and the angle travelled, so that they do not depend on
    how a path is cut into increments. The defaults are what measured relations between poses show of
    indoor robots with wheel odometry: 0.05 rad/sqrt(m) straight on, 0.09 to 0.14 rad/sqrt(rad) in turns.
    """

    forward: float = parameter(
        0.05, "m/sqrt(m)", "error along the way, per root metre", ge=0, noise=True
    )
    sideways: float = parameter(
        0.03, "m/sqrt(m)", "error across the way, per root metre", ge=0, noise=True
    )
    turn_per_distance: float = parameter(
        0.05, "rad/sqrt(m)", "heading error of driving, per root metre", ge=0, noise=True
    )
    turn_per_turn: float = parameter(
        0.15, "rad/sqrt(rad)", "heading error of turning (slip), per root radian", ge=0, noise=True
    )

    def variances(self, distances: Array, angles: Array) -> Array:
        """Return (m, 3): of m motions over (m,) m and (m,) rad; along, across, of the heading."""
        way, turn = np.abs(distances), np.abs(angles)
        out = np.empty((len(way), 3))
        out[:, 0] = self.forward**2 * way
        out[:, 1] = self.sideways**2 * way
        out[:, 2] = self.turn_per_distance**2 * way + self.turn_per_turn**2 * turn
        return out

    def covariance(self, distance: float, angle: float) -> Array:
        """Return (3, 3) for a way of `distance` m and a turn of `angle` rad, in the body frame."""
        (of_one,) = self.variances(np.array([distance]), np.array([angle]))
        return np.diag(of_one)
