"""Dead reckoning: the motion is that of odometry (thesis 3.5)."""

from __future__ import annotations

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import register
from impslam.health import CARRIED, CHANGED, MISTIMED
from impslam.tracking.base import Gate, Tracker, mark_keyframes
from impslam.tracking.beams import beam_columns
from impslam.tracking.jump import JumpCheck
from impslam.tracking.odometry_check import OdometryCheck
from impslam.tracking.per_lidar import PerLidar
from impslam.tracking.stall import StallState, initial_stall_state, undo_stalled_motion
from impslam.tracking.steps import Steps
from impslam.tracking.traction import Traction


@register("odometry")
class OdometryTracker(Tracker):
    """Follows odometry alone, as the thesis does, unless the scans contradict it."""

    _check: OdometryCheck = PrivateAttr(default_factory=OdometryCheck)
    _traction: Traction = PrivateAttr(default_factory=Traction)
    _jumps: JumpCheck = PrivateAttr(default_factory=JumpCheck)
    _stalls: PerLidar[StallState] = PrivateAttr(
        default_factory=lambda: PerLidar(initial_stall_state)
    )

    def steps(self, motions: Motions, sweeps: Sweeps, gate: Gate) -> Steps:
        """Follow odometry; see `Tracker.steps`."""
        m, beams = len(sweeps), beam_columns(sweeps.scans, len(sweeps))
        motions = motions._replace(covariance=motions.covariance.copy())
        slipped = self._traction.widen(motions.duration, motions.d_pose, motions.covariance)
        checked, reasons, amounts = self._check.check(motions, beams)
        stall = self._stalls.get(sweeps.sensor, beams.ranges.shape[1])
        undo_stalled_motion(motions.d_pose, checked, beams, stall, reasons)
        reasons = np.maximum(reasons, slipped)
        amounts[reasons > MISTIMED] = 0.0
        shares, confirmed = self._jumps.find(checked, beams, sweeps.sensor)
        changed = shares > 0.0
        reasons[changed], amounts[changed] = CHANGED, shares[changed]
        reasons[confirmed] = CARRIED
        keyframes = mark_keyframes(checked.d_pose, motions.duration, reasons == CARRIED, gate)
        return Steps(
            checked.d_pose, checked.covariance, np.zeros((m, 3, 3)), checked.d_pose,
            np.ones(m, np.bool_), keyframes, np.zeros(m, np.bool_), reasons, amounts, np.zeros((m, 2)),
        )  # fmt: skip
