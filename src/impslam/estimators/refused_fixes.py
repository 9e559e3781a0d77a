"""GPS fixes outside the gate: outliers, or a pose with an error beyond its covariance.

A covariance that is too small makes the gate refuse all later fixes. Reflections change with the place, so
refused fixes that agree with the driven path over many standard deviations are right. They agree if a rigid
motion maps them onto the antenna positions of the filter:

    p_i = t + R(phi) z_i + e_i,    sum e_i^T (R(phi) R_i R(phi)^T)^-1 e_i < chi2(2 n - 3),

with the least-squares t and phi of Umeyama (1991). The difference of that motion from the estimated GPS
frame is then the error of the pose, and is added to the belief as noise of that standard deviation. A frame
that no fix has confirmed since its first one is removed instead: that fix was the outlier.
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

MIN_FIXES = 8  # leave 13 degrees of freedom for the test
MIN_SPAN = 10.0  # standard deviations driven, as `sensors.gps` requires for a course
MIN_STEP = (
    0.1  # standard deviations between fixes: those of a stationary robot would fill the memory
)
AGREEMENT = 0.99  # quantile of the test


class _Refused(NamedTuple):
    position: Array  # (2,) of the antenna according to the filter
    z: Array
    R: Array


class PoseError(NamedTuple):
    """Error of the pose: (3, 3) covariance of [x, y, theta] in base_link, m^2 and rad^2."""

    covariance: Array
    frame_is_wrong: bool


class RefusedFixes:
    """The refused fixes since the last used one."""

    def __init__(self) -> None:
        self._fixes: list[_Refused] = []

    def __len__(self) -> int:
        return len(self._fixes)

    def accept(self) -> None:
        """Forget them, because a fix was used."""
        self._fixes.clear()

    def refuse(self, antenna: Array, fix: Observation, frame: Landmark) -> PoseError | None:
        """Add a refused fix, with the antenna at (2,) in map; return the pose's error once they agree."""
        if self._fixes and not _has_moved(antenna, self._fixes[-1]):
            return None
        self._fixes.append(_Refused(antenna.copy(), fix.z, fix.R))
        while len(self._fixes) > MIN_FIXES and _spans(self._fixes[1:]):
            del self._fixes[0]
        if len(self._fixes) < MIN_FIXES or not _spans(self._fixes):
            return None
        turn, shift = _fitted(self._fixes)
        if not _agree(self._fixes, turn, shift):
            return None
        self._fixes.clear()
        measured = frame.position + rotation(frame.parameters["yaw"]) @ fix.z
        error = measured - (shift + rotation(turn) @ fix.z)
        heading = wrap(turn - frame.parameters["yaw"])
        covariance = np.diag([error @ error, error @ error, float(heading) ** 2])
        return PoseError(covariance, frame.observations <= 1)


def _has_moved(antenna: Array, fix: _Refused) -> bool:
    """Return whether the antenna at (2,) has moved by `MIN_STEP` standard deviations since a fix."""
    sigma = math.sqrt(np.trace(fix.R) / 2.0)
    return bool(np.hypot(*(antenna - fix.position)) >= MIN_STEP * sigma)


def _spans(fixes: Sequence[_Refused]) -> bool:
    """Return whether the robot moved by at least `MIN_SPAN` standard deviations."""
    positions = np.array([fix.position for fix in fixes])
    sigma = math.sqrt(np.mean([np.trace(fix.R) / 2.0 for fix in fixes]))
    return bool(np.hypot(*(positions - positions[-1]).T).max() >= MIN_SPAN * sigma)


def _fitted(fixes: Sequence[_Refused]) -> tuple[float, Array]:
    """Return the angle (rad) and the shift (2,) m that map the fixes onto the positions."""
    positions, z = np.array([fix.position for fix in fixes]), np.array([fix.z for fix in fixes])
    p, q = positions - positions.mean(axis=0), z - z.mean(axis=0)
    turn = math.atan2(float(np.sum(q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0])), float(np.sum(q * p)))
    return turn, positions.mean(axis=0) - rotation(turn) @ z.mean(axis=0)


def _agree(fixes: Sequence[_Refused], turn: float, shift: Array) -> bool:
    """Return whether the fixes lie on the driven path within their noise."""
    R = rotation(turn)
    total = 0.0
    for fix in fixes:
        error = fix.position - shift - R @ fix.z
        total += float(error @ np.linalg.solve(R @ fix.R @ R.T, error))
    return bool(total < quantile(AGREEMENT, 2 * len(fixes) - 3))
