"""Fixes of a GPS that the gate refuses: outliers, or a pose that is further off than its covariance says.

A covariance that is too small makes the gate refuse every fix for ever. Reflections change with the
place, so refused fixes that agree with the driven way over many standard deviations are right. They agree
if a rigid motion takes them onto the places where the filter had the antenna:

    p_i = t + R(phi) z_i + e_i,    sum e_i^T (R(phi) R_i R(phi)^T)^-1 e_i < chi2(2 n - 3),

with the least-squares t and phi of Umeyama (1991). How far that motion lies from the frame of the GPS is
then the pose's error, and enters the belief as noise of one standard deviation of that size. A frame that
no fix has confirmed since its first one is forgotten instead, since that fix was the outlier.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import quantile
from impslam.geometry.se2 import rotation
from impslam.types import Array, Landmark, Observation

LEAST = 8  # fixes: 13 degrees of freedom are left to disagree with
FAR = 10.0  # standard deviations of way: as `sensors.gps` asks for a course
SURE = 0.99  # quantile within which they agree


class _Refused(NamedTuple):
    place: Array  # (2,) where the filter had the antenna
    z: Array
    R: Array


class PoseError(NamedTuple):
    """How far the pose is off: (3, 3) covariance of [x, y, theta] in base_link, m^2 and rad^2."""

    covariance: Array
    frame_is_wrong: bool


class RefusedFixes:
    """The fixes refused since the last one that was used."""

    def __init__(self) -> None:
        self._fixes: list[_Refused] = []

    def accept(self) -> None:
        """Forget them: a fix was used."""
        self._fixes.clear()

    def refuse(self, antenna: Array, fix: Observation, frame: Landmark) -> PoseError | None:
        """Take a fix refused with the antenna at (2,) in map; return the pose's error once they agree."""
        self._fixes.append(_Refused(antenna.copy(), fix.z, fix.R))
        while len(self._fixes) > LEAST and _spans(self._fixes[1:]):
            del self._fixes[0]
        if len(self._fixes) < LEAST or not _spans(self._fixes):
            return None
        turn, shift = _fitted(self._fixes)
        if not _agree(self._fixes, turn, shift):
            return None
        self._fixes.clear()
        told = frame.position + rotation(frame.parameters["yaw"]) @ fix.z
        off = told - (shift + rotation(turn) @ fix.z)
        heading = wrap(turn - frame.parameters["yaw"])
        covariance = np.diag([off @ off, off @ off, float(heading) ** 2])
        return PoseError(covariance, frame.observations <= 1)


def _spans(fixes: Sequence[_Refused]) -> bool:
    """Tell whether the robot moved by many standard deviations meanwhile."""
    places = np.array([fix.place for fix in fixes])
    sigma = math.sqrt(np.mean([np.trace(fix.R) / 2.0 for fix in fixes]))
    return bool(np.hypot(*(places - places[-1]).T).max() >= FAR * sigma)


def _fitted(fixes: Sequence[_Refused]) -> tuple[float, Array]:
    """Return the angle (rad) and the shift (2,) m that take the fixes onto the places."""
    places, z = np.array([fix.place for fix in fixes]), np.array([fix.z for fix in fixes])
    p, q = places - places.mean(axis=0), z - z.mean(axis=0)
    turn = math.atan2(float(np.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0])), float(np.sum(q * p)))
    return turn, places.mean(axis=0) - rotation(turn) @ z.mean(axis=0)


def _agree(fixes: Sequence[_Refused], turn: float, shift: Array) -> bool:
    """Tell whether the fixes lie on the driven way within their noise."""
    R = rotation(turn)
    total = 0.0
    for fix in fixes:
        off = fix.place - shift - R @ fix.z
        total += float(off @ np.linalg.solve(R @ fix.R @ R.T, off))
    return bool(total < quantile(SURE, 2 * len(fixes) - 3))
