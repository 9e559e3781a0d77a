"""Match the scans of a robot that stands although its wheels turn; see `stall`.

Its scans show no motion at all, but where few points determine the position along a corridor, matches
follow odometry. So they begin at the pose of the scan that has not changed since. The motions of odometry
whose noise is as large as they are do not show that the wheels turn.
"""

from __future__ import annotations

from impslam.geometry.kernels import kernel
from impslam.health import STALLED
from impslam.tracking.beams import BeamColumns
from impslam.tracking.learned_odometry import variances
from impslam.tracking.matching_state import State
from impslam.tracking.reference_scan import MIN_MOTION
from impslam.tracking.stall import IS_STALLED, POSE_IS_DUE, STALL_SIGMA, notice_stall
from impslam.tracking.steps import Steps


@kernel
def predict_stalled(beams: BeamColumns, k: int, state: State) -> bool:
    """Return whether the robot stands at sweep k although odometry moves; then predict where it stands."""
    stall = state.lidar.stall
    noise, _ = variances(state.odometry, MIN_MOTION[0], 0.0)
    if not stall.flags[IS_STALLED] and 9.0 * noise > MIN_MOTION[0] ** 2:  # 3 sigma
        stall.flags[:] = False
        return False
    if not notice_stall(state.motion, beams, k, stall):
        return False
    state.pose[:] = stall.pose
    state.prior[:], state.slip[:] = STALL_SIGMA**2, 0.0
    return True


@kernel
def report_stalled(k: int, state: State, out: Steps) -> None:
    """Report sweep k as one of a stalled robot, unless it has a worse reason."""
    if out.reasons[k] < STALLED:
        out.reasons[k], out.amounts[k] = STALLED, 0.0
        state.faults.newest[0], state.faults.newest[1] = STALLED, 0.0


@kernel
def set_reference_pose(state: State) -> None:
    """Store the pose of the newest scan, after its match, if it has become the reference scan."""
    stall = state.lidar.stall
    if stall.flags[POSE_IS_DUE]:
        stall.pose[:], stall.flags[POSE_IS_DUE] = state.pose, False
