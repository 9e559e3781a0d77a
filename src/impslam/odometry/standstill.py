"""Standing still: an encoder's trembling is no motion, and adds nothing to the covariance.

Each step of a trembling reading counts as motion otherwise: the way and its variance grow for ever.
A robot stands where its odometry has stayed within a band for `SECONDS`. It then stays at that place, with
no motion at all, until odometry leaves the band; all motion since goes into that one step, so that
none is lost (a zero-velocity update, Foxlin 2005, on the wheels alone).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.types import Array

SECONDS = 0.5
"""A robot that has stayed so long within the band stands. The slowest drive that counts is the band's
width in this time: about 1 mm/s."""


class Band(NamedTuple):
    """How far the odometry of a standing robot strays, m and rad; 0: it does not."""

    distance: float = 0.0
    angle: float = 0.0


class Standstill:
    """Takes the motion out of odometry's motions while the robot stands, batch by batch."""

    def __init__(self, band: Band) -> None:
        self._band = band
        self._strayed, self._clock = np.zeros(3), np.array([SECONDS])

    def hold(self, motions: Motions) -> Motions:
        """Return motions (m,) with those of a standing robot exactly zero; NaN stays as it is."""
        if not self._band.distance:
            return motions
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        _hold(d_pose, covariance, motions.duration, self._band, (self._strayed, self._clock))
        return motions._replace(d_pose=d_pose, covariance=covariance)


@kernel
def _hold(
    d_pose: Array, covariance: Array, duration: Array, band: Band, state: tuple[Array, Array]
) -> None:
    """Change motions (m, 3) and covariances (m, 3, 3) in place.

    The state is the motion (3,) since the place where the robot may stand, and for how long, s (1,).
    """
    strayed, clock = state
    for k in range(len(d_pose)):
        if math.isnan(d_pose[k, 0]):
            continue
        advance_pose(strayed, d_pose[k])
        within = math.hypot(strayed[0], strayed[1]) <= band.distance
        within = within and abs(strayed[2]) <= band.angle
        if clock[0] < SECONDS:
            clock[0] = clock[0] + duration[k] if within else 0.0
            if not within or clock[0] >= SECONDS:
                strayed[:] = 0.0
        elif within:
            d_pose[k], covariance[k] = 0.0, 0.0
        else:
            d_pose[k] = strayed
            for a in range(3):  # where it stood is known up to the band: uniform in it
                half = band.angle if a == 2 else band.distance
                covariance[k, a, a] += half * half / 3.0
            strayed[:], clock[0] = 0.0, 0.0
