"""Detect a robot that is stationary while its wheels turn: against a wall, on a threshold, high-centred.

A reference scan is kept. Once odometry reports enough motion since, the ranges that this motion would have
changed are predicted: each reference point, seen from the pose given by odometry, is compared with the
range measured before by the beam in its direction. If nearly all beams that should have changed still
measure the same, and still do after as much motion once more, the robot is stationary. One comparison is
not enough: things along a corridor may repeat, and a wheel may slip. Nor is one direction: if odometry is
noisy, the robot may have moved along walls that it expects to approach. Along a bare corridor no range
would change, so nothing is concluded; a scan matcher could report any motion there. Turns reported by
odometry are left out: its heading is often wrong by enough to change many ranges. But if no range would
change with the turn either, as on an arc along a round wall, nothing is concluded. Wheels that turn the
robot in vain are detected by `odometry_check`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.algebra import between
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.health import STALLED, Reasons
from impslam.tracking.beams import BeamColumns, Geometry
from impslam.tracking.reference_scan import MIN_MOTION, RANGE_TOLERANCE, changed_beam
from impslam.types import Array, Mask

MIN_BEAMS = 10
"""Beams that should have changed; with fewer, nothing is concluded."""
MIN_UNCHANGED = 0.8
"""Share of them that measure the same; the rest see people or edges. For a moving robot it is near 0."""
STALL_SIGMA = 0.05
"""m, 1 sigma, of a stalled robot: its wheels may have shoved it."""

HAS_REFERENCE, IS_STALLED, POSE_IS_DUE, UNCHANGED_ONCE = range(4)
"""Indices of `StallState.flags`."""


class StallState(NamedTuple):
    """The reference scan of one lidar and the motion since; kernels change it in place.

    Attributes
    ----------
    ranges, points : (n,) m and (n, 2) m in base_link, of the reference scan; 0 where invalid
    odometry : (3,) motion since the reference scan, by odometry; of a stalled robot, since the last sweep
    pose : (3,) of base_link at the reference scan, in the frame of a map; or the motion since, see
        `undo_stalled_motion`
    flags : (4,) by `HAS_REFERENCE`, whether there is a reference scan; by `IS_STALLED`, whether the robot
        is; by `POSE_IS_DUE`, whether the newest sweep has become the reference scan and `pose` is not set
        yet; by `UNCHANGED_ONCE`, whether one comparison has found the ranges unchanged
    """

    ranges: Array
    points: Array
    odometry: Array
    pose: Array
    flags: Mask


def initial_stall_state(beams: int) -> StallState:
    """Return the state before the first scan of a lidar with this number of beams."""
    return StallState(
        np.zeros(beams), np.zeros((beams, 2)), np.zeros(3), np.zeros(3), np.zeros(4, np.bool_)
    )


@kernel
def undo_stalled_motion(
    odometry: Array, used: Motions, beams: BeamColumns, state: StallState, reasons: Reasons
) -> None:
    """Undo, in place, the motions used while the robot was stalled; mark these sweeps `STALLED`.

    `odometry` (m, 3) are the motions by odometry, `used` those handed on; both belong to the sweeps in
    `beams`. The state's `pose` is the motion handed on since the reference scan.
    """
    before, origin = np.empty(3), np.zeros(3)
    for k in range(len(odometry)):
        before[:] = state.pose
        advance_pose(state.pose, used.d_pose[k])
        if notice_stall(odometry[k], beams, k, state):
            between(before, origin, used.d_pose[k])
            used.covariance[k] = np.outer(before, before)
            for a in range(3):
                used.covariance[k, a, a] += STALL_SIGMA**2
            reasons[k] = STALLED
        if state.flags[IS_STALLED] or state.flags[POSE_IS_DUE]:
            state.pose[:], state.flags[POSE_IS_DUE] = 0.0, False


@kernel
def notice_stall(odometry: Array, beams: BeamColumns, k: int, state: StallState) -> bool:
    """Return whether the robot is stalled at sweep k, after a motion (3,) of odometry."""
    advance_pose(state.odometry, odometry)
    if state.flags[HAS_REFERENCE] and not state.flags[IS_STALLED]:
        distance = math.hypot(state.odometry[0], state.odometry[1])
        comparison = 2.0 if state.flags[UNCHANGED_ONCE] else 1.0
        enough = distance >= comparison * MIN_MOTION[0]
        if not enough and abs(state.odometry[2]) < comparison * MIN_MOTION[1]:
            return False
    # A stalled robot moves off in the direction of the newest motion.
    expected = odometry if state.flags[IS_STALLED] else state.odometry
    unchanged = state.flags[HAS_REFERENCE] and _is_unchanged(
        beams.ranges[k], expected, beams.geometry, state
    )
    if unchanged and not state.flags[IS_STALLED] and not state.flags[UNCHANGED_ONCE]:
        state.flags[UNCHANGED_ONCE] = True
        return False
    state.odometry[:] = 0.0
    state.flags[IS_STALLED], state.flags[UNCHANGED_ONCE] = unchanged, False
    if not state.flags[IS_STALLED]:
        state.flags[HAS_REFERENCE] = state.flags[POSE_IS_DUE] = True
        state.points[:], state.ranges[:] = beams.points[k], beams.ranges[k]
    return bool(state.flags[IS_STALLED])


@kernel
def _is_unchanged(ranges: Array, expected: Array, geometry: Geometry, state: StallState) -> bool:
    """Return whether nearly all ranges that a motion (3,) should have changed are those of the reference.

    So must those be that a motion to the left of it would have changed. A shorter motion is scaled up to
    `MIN_MOTION` m, so that the beams that it would change stand out.
    """
    distance = math.hypot(expected[0], expected[1])
    motion = expected * (max(MIN_MOTION[0] / distance, 1.0) if distance > 0.0 else 1.0)
    forward = np.array([motion[0], motion[1], 0.0])
    leftward = np.array([-motion[1], motion[0], 0.0])
    for straight in (forward, leftward):
        changed, same = _compare(ranges, straight, geometry, state)
        if changed < MIN_BEAMS or same < MIN_UNCHANGED * changed:
            return False
    return _compare(ranges, motion, geometry, state)[0] >= MIN_BEAMS


@kernel
def _compare(
    ranges: Array, motion: Array, geometry: Geometry, state: StallState
) -> tuple[int, int]:
    """Return the number of beams that a motion (3,) should have changed, and of those that it did not."""
    changed = same = 0
    for j in range(len(ranges)):
        k, _ = changed_beam(j, motion, state.points, state.ranges, geometry)
        if k >= 0 and ranges[k] > 0.0:
            changed += 1
            tolerance = RANGE_TOLERANCE[0] + RANGE_TOLERANCE[1] * state.ranges[k]
            same += abs(ranges[k] - state.ranges[k]) < tolerance
    return changed, same
