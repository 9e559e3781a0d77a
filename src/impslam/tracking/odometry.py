"""Dead reckoning: the motion is what odometry says (thesis 3.5)."""

from __future__ import annotations

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import register
from impslam.tracking.base import Gate, Steps, Tracker, count
from impslam.tracking.check import OdometryCheck
from impslam.tracking.surfels import prepare


@register("odometry")
class OdometryTracker(Tracker):
    """Follows odometry alone, as the thesis does, unless the scans contradict it."""

    _check: OdometryCheck = PrivateAttr(default_factory=OdometryCheck)

    def steps(self, motions: Motions, sweeps: Sweeps, gate: Gate) -> Steps:
        """Follow odometry; see `Tracker.steps`."""
        scans = sweeps.scans
        surfels = None if scans is None else prepare(scans, OdometryCheck.spacing)
        checked, contradicted = self._check.check(motions, surfels)
        m = len(sweeps)
        ends = count(checked.d_pose, motions.duration, gate)
        return Steps(
            checked.d_pose, checked.covariance, checked.d_pose, np.ones(m, np.bool_), ends,
            contradicted, np.zeros(m, np.bool_),
        )  # fmt: skip
