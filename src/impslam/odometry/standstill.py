"""Detect a standstill, so that the jitter of encoders is no motion and adds nothing to the covariance.

Otherwise each step of a jittering reading counts as motion, and the distance and its variance grow without
bound. The robot is stationary once odometry has stayed within a band for `STANDSTILL_TIME`. Its motion is
then exactly zero until odometry leaves the band; all motion since goes into that one step, so that none is
lost (a zero-velocity update, Foxlin 2005, on the wheels alone).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.types import Array

STANDSTILL_TIME = 0.5
"""s within the band until the robot is stationary. The slowest drive that counts is the band's width in
this time: about 1 mm/s."""


class Band(NamedTuple):
    """Largest motion by the odometry of a stationary robot, m and rad; 0: none."""

    distance: float = 0.0
    angle: float = 0.0


class Standstill:
    """Suppresses the motions of odometry while the robot is stationary, batch by batch."""

    def __init__(self, band: Band) -> None:
        self._band = band
        self._moved, self._clock = np.zeros(3), np.array([STANDSTILL_TIME])

    def suppress(self, motions: Motions) -> Motions:
        """Return motions (m,) with those of a stationary robot set to zero; NaN stays."""
        if not self._band.distance:
            return motions
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        _suppress(d_pose, covariance, motions.duration, self._band, (self._moved, self._clock))
        return motions._replace(d_pose=d_pose, covariance=covariance)


@kernel
def _suppress(
    d_pose: Array, covariance: Array, duration: Array, band: Band, state: tuple[Array, Array]
) -> None:
    """Change motions (m, 3) and covariances (m, 3, 3) in place.

    The state is the motion (3,) since the robot may have stopped, and the time since then, s (1,).
    """
    moved, clock = state
    for k in range(len(d_pose)):
        if math.isnan(d_pose[k, 0]):
            continue
        advance_pose(moved, d_pose[k])
        within = math.hypot(moved[0], moved[1]) <= band.distance
        within = within and abs(moved[2]) <= band.angle
        if clock[0] < STANDSTILL_TIME:
            clock[0] = clock[0] + duration[k] if within else 0.0
            if not within or clock[0] >= STANDSTILL_TIME:
                moved[:] = 0.0
        elif within:
            d_pose[k], covariance[k] = 0.0, 0.0
        else:
            d_pose[k] = moved
            for a in range(3):  # the position is uniform within the band
                half = band.angle if a == 2 else band.distance
                covariance[k, a, a] += half * half / 3.0
            moved[:], clock[0] = 0.0, 0.0
