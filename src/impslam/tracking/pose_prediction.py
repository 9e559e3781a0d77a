"""Predict the pose of a sweep before it is matched: by odometry, else at constant velocity."""

from __future__ import annotations

import math

from impslam.columns import Motions
from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.kernels import kernel
from impslam.noise import LEAST_UNKNOWN
from impslam.tracking.frozen import remains_frozen
from impslam.tracking.fusion import MAX_COAST, RATE_SIGMA, SPEED_SIGMA
from impslam.tracking.learned_odometry import correct, variances
from impslam.tracking.match_faults import MAX_SPEED, is_slipping
from impslam.tracking.matching_state import (
    DISTANCE,
    HEADING,
    INTERVAL,
    POSITION,
    SECONDS,
    TURN,
    State,
)
from impslam.tracking.reach import widen_after_gap
from impslam.types import Array

SLIP_SHARE = 0.5
"""Additional standard deviation of odometry while wheels slip, as a share of the motion: they report about
twice the motion, or less than all of it if they are dragged."""
INTERVAL_MEMORY = 0.01
"""Weight of the newest sweep in the running mean of the time between sweeps without odometry."""


@kernel
def predict(motions: Motions, k: int, state: State, d_pose: Array) -> bool:
    """Predict the pose of sweep k by odometry, else at constant velocity; return True for the latter.

    Frozen odometry is none. Velocity is per sweep, because some logs have stamps that run backwards.
    """
    no_odometry = bool(motions.covariance[k, 0, 0] >= LEAST_UNKNOWN)
    no_odometry |= remains_frozen(motions.d_pose[k], state)
    covariance = motions.covariance[k].copy()
    if no_odometry:
        seconds = min(motions.duration[k], MAX_COAST)
        state.averages[INTERVAL] += INTERVAL_MEMORY * (seconds - state.averages[INTERVAL])
        seconds = max(seconds, state.averages[INTERVAL])
        d_pose[:], covariance[:] = state.velocity, 0.0
        position, heading = (SPEED_SIGMA * seconds + 0.01) ** 2, (RATE_SIGMA * seconds + 0.01) ** 2
        covariance[0, 0], covariance[1, 1], covariance[2, 2] = position, position, heading
    else:
        d_pose[:] = motions.d_pose[k]
        state.reported[0] += d_pose[2]
        correct(state.odometry, d_pose)
    state.travelled[DISTANCE] += math.hypot(d_pose[0], d_pose[1])
    state.travelled[TURN] += abs(d_pose[2])
    state.travelled[SECONDS] += motions.duration[k]
    before = state.interval[0]
    least = math.hypot(d_pose[0], d_pose[1]) / MAX_SPEED  # time has passed, whatever clocks say
    state.interval[0] = max(motions.duration[k], least)
    state.interval[1] = motions.stamps[k] - state.stamp[0]
    state.stamp[0] = motions.stamps[k]
    if not no_odometry:
        position, heading = variances(
            state.odometry, state.travelled[DISTANCE], state.travelled[TURN]
        )
    state.prior[POSITION], state.prior[HEADING] = position, heading
    state.slip[:] = 0.0
    if not no_odometry and is_slipping(state.faults):
        state.slip[POSITION] = (SLIP_SHARE * state.travelled[DISTANCE]) ** 2
        state.slip[HEADING] = (SLIP_SHARE * state.travelled[TURN]) ** 2
    advance_pose(state.pose, d_pose)
    advance(state.motion, state.covariance, d_pose, covariance)
    widen_after_gap(state, before, no_odometry)
    return no_odometry
