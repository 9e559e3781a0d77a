"""Where the robot may be after a gap in the data that odometry does not cover.

It is anywhere within what it can have driven. Matching finds the place there that fits best near the
predicted pose; whether another one looks the same is for the estimator to tell, which has the whole map.
"""

from __future__ import annotations

import math

from impslam.geometry.kernels import kernel
from impslam.map import REACH_SIGMAS
from impslam.noise import MIN_BREAK, UNKNOWN
from impslam.tracking.frozen import MIN_SECONDS
from impslam.tracking.fusion import RATE_SIGMA
from impslam.tracking.hypotheses import MAX_SLIP
from impslam.tracking.intervals import is_gap
from impslam.tracking.match_faults import WINDOW
from impslam.tracking.matching_state import HEADING, POSITION, State


@kernel
def is_after_gap(state: State) -> bool:
    """Return whether the newest interval is a gap, during which no scans determined the position.

    If odometry was silent meanwhile, its whole motion comes at once.
    """
    seen = (
        not is_gap(state.interval[1], state.intervals, WINDOW) and state.faults.unlocated[0] == 0.0
    )
    return is_gap(state.interval[0], state.intervals, WINDOW) and not seen


@kernel
def widen_after_gap(state: State, before: float, no_odometry: bool) -> None:
    """Widen the prior and set the reach if the newest interval is a gap of more than a slip.

    Odometry's covariance tells how far the robot may be from the predicted pose. Without odometry, it may
    have gone on at its last speed, in any direction; `before` is the last interval in s. If another drive
    may have begun, what odometry reports may be no motion, and the robot may be anywhere.
    """
    if not is_after_gap(state):
        return
    seconds = state.interval[0]
    if no_odometry:
        distance = math.hypot(state.velocity[0], state.velocity[1])
        speed = distance / max(before, state.intervals[1], MIN_SECONDS)
        position = 0.5 * (speed * seconds / REACH_SIGMAS) ** 2
        heading = (RATE_SIGMA * seconds) ** 2
    else:
        position = 0.5 * (state.covariance[0, 0] + state.covariance[1, 1])
        heading = state.covariance[2, 2]
    reach = REACH_SIGMAS * math.sqrt(2.0 * position)
    if reach > MAX_SLIP[0]:
        state.reach[POSITION] = reach
        state.reach[HEADING] = min(REACH_SIGMAS * math.sqrt(heading), math.pi)
        state.prior[POSITION] = max(state.prior[POSITION], position)
        state.prior[HEADING] = max(state.prior[HEADING], heading)
        if seconds > MIN_BREAK:
            state.reach[POSITION] = REACH_SIGMAS * math.sqrt(2.0 * UNKNOWN)
            state.reach[HEADING] = math.pi
