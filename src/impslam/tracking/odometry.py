"""Dead reckoning: the motion is what odometry says (thesis 3.5)."""

from __future__ import annotations

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Scans, Sweeps
from impslam.component import register
from impslam.tracking.base import Gate, Steps, Tracker, count
from impslam.tracking.check import OdometryCheck
from impslam.tracking.standing import Standing, hold, no_reference
from impslam.tracking.surfels import prepare
from impslam.tracking.traction import Traction


@register("odometry")
class OdometryTracker(Tracker):
    """Follows odometry alone, as the thesis does, unless the scans contradict it."""

    _check: OdometryCheck = PrivateAttr(default_factory=OdometryCheck)
    _traction: Traction = PrivateAttr(default_factory=Traction)
    _standing: dict[str, Standing] = PrivateAttr(default_factory=dict)

    def steps(self, motions: Motions, sweeps: Sweeps, gate: Gate) -> Steps:
        """Follow odometry; see `Tracker.steps`."""
        scans, m = sweeps.scans, len(sweeps)
        motions = motions._replace(covariance=motions.covariance.copy())
        slipped = self._traction.widen(motions.duration, motions.d_pose, motions.covariance)
        surfels = None if scans is None else prepare(scans, OdometryCheck.spacing)
        checked, reasons = self._check.check(motions, surfels)
        if scans is not None:
            hold(motions.d_pose, checked, scans, self._reference_of(sweeps.sensor, scans), reasons)
        reasons = np.maximum(reasons, slipped)
        ends = count(checked.d_pose, motions.duration, gate)
        return Steps(
            checked.d_pose, checked.covariance, checked.d_pose, np.ones(m, np.bool_), ends,
            np.zeros(m, np.bool_), reasons, np.zeros(m),
        )  # fmt: skip

    def _reference_of(self, sensor: str, scans: Scans) -> Standing:
        """Return what is kept of a lidar; motions to the sweeps of others are not compared."""
        beams, kept = scans.ranges.shape[1], self._standing.get(sensor)
        if kept is None or len(kept.ranges) != beams:
            kept = self._standing[sensor] = no_reference(beams)
        return kept
