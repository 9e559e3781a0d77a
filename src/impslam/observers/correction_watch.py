"""Checks whether landmarks keep correcting the motion by odometry in one direction.

The corrections of a consistent filter are white: at each keyframe their mean is zero, and their covariance
is that of the prediction minus that of the estimate (Bar-Shalom et al. 2001, ch. 5.4). Their sum over the
last metres, divided by its standard deviation, reveals wheels that slip by a few percent, wrong parameters
of odometry, and late scans long before the innovations exceed their gates.
"""

from __future__ import annotations

import numpy as np

from impslam.geometry.algebra import rotate_covariance
from impslam.geometry.se2 import between, compose_uncertain
from impslam.map import Keyframe, Revision
from impslam.types import Array

WINDOW = 20.0
"""Keyframes (2 m of travel) over which corrections are added up."""
MAX_SCORE = 5.0
"""Sum in standard deviations; a normal variable exceeds it once in two million cases."""
MAX_CORRECTION = 3.0
"""Standard deviations at which each correction is clipped: one wrong match does not decide."""
MIN_SIGMA = np.array([1e-4, 1e-4, 1e-5])
"""m, m, rad: smallest standard deviation; smaller ones are rounding errors."""


class CorrectionWatch:
    """Adds up the corrections of the motions between keyframes, in the robot's frame."""

    def __init__(self) -> None:
        self._last: tuple[Array, Array] | None = None  # pose and covariance at the last keyframe
        self._sum, self._variance = np.zeros(3), np.zeros(3)

    def revise(self, keyframe: Keyframe, revision: Revision) -> bool:
        """Add a keyframe; return whether its corrections and those before have a bias."""
        if self._last is None and not revision.matches:
            return False
        new = revision.poses[-1].copy(), revision.covariances[-1].copy()
        if self._last is not None and len(revision.ids) == 1 and not keyframe.lost:
            predicted, P = compose_uncertain(
                *self._last, keyframe.motion.d_pose, keyframe.motion.covariance
            )
            in_robot = rotate_covariance(P - new[1], -predicted[2])
            variance = np.maximum(np.diag(in_robot), 0.0)
            limit = MAX_CORRECTION * np.sqrt(variance)
            correction = np.clip(between(predicted, new[0]), -limit, limit)
            keep = 1.0 - 1.0 / WINDOW
            self._sum = keep * self._sum + correction
            self._variance = keep**2 * self._variance + variance
        self._last = new
        sigma = np.maximum(np.sqrt(self._variance), MIN_SIGMA)
        return bool((np.abs(self._sum) > MAX_SCORE * sigma).any())
