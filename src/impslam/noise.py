"""Noise of a wheeled robot's dead reckoning: variances that grow with the distance travelled."""

from __future__ import annotations

import numpy as np

from impslam.parameters import Parameters, parameter
from impslam.types import Array

UNKNOWN = 1e6
"""m^2: variance of an unknown motion, as for a robot without odometry."""

MAX_GAP = 3.0
"""s between two readings or two sweeps; after a longer gap the robot's path is unknown."""


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
