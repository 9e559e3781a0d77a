"""Detect that odometry is frozen: it stands still while the robot moves, as with a broken encoder cable.

Scans that determine the position show this at once. Along a bare corridor they do not, and frozen odometry
would stop the estimate there. So it remains frozen until it moves again, or until scans show that the robot
stands. Meanwhile the pose is predicted as without odometry.
"""

from __future__ import annotations

import math

from impslam.geometry.kernels import kernel
from impslam.health import PUSHED
from impslam.tracking.match_faults import LONG_WINDOW, MIN_MOTION, STATIONARY_SHARE
from impslam.tracking.match_information import add_along
from impslam.tracking.matching_state import SECONDS, Settings, State
from impslam.tracking.steps import Steps
from impslam.types import Array

MAX_MOTION = 0.005, 0.01
"""m, rad: odometry that shows less between two matches stands still; encoders at rest flicker by a tick."""
SPACING = 0.05
"""m that the robot may move between two scans of a submap while odometry stands still: matches of closer
scans gain nothing, and scans farther apart may be matched to the wrong one of two similar things."""
MIN_SECONDS = 1e-3
"""s: smallest time between two matches, since stamps may stand still."""


@kernel
def remains_frozen(d_pose: Array, state: State) -> bool:
    """Return whether odometry is still frozen in a sweep in which it moves by `d_pose` (3,)."""
    moved, expected = (
        math.hypot(d_pose[0], d_pose[1]),
        math.hypot(state.velocity[0], state.velocity[1]),
    )
    if moved > STATIONARY_SHARE * expected or abs(d_pose[2]) > MIN_MOTION[1]:
        state.frozen.is_frozen[0] = False
    return bool(state.frozen.is_frozen[0])


@kernel
def notice_frozen(k: int, duration: float, state: State, settings: Settings, out: Steps) -> bool:
    """Update whether odometry is frozen, after the match of sweep k, which lasts `duration` s.

    If it is found to be frozen after it has stood still in a corridor, the robot may have gone on since
    then at its last speed. Returns whether it may have gone on by `SPACING` since the last match: then
    things that come into view show how far it goes, but only if the submaps contain them.
    """
    frozen, velocity = state.frozen, state.velocity
    seconds = max(state.travelled[SECONDS], MIN_SECONDS)
    if out.reasons[k] == PUSHED and not frozen.is_frozen[0]:
        frozen.is_frozen[0] = True
        axis = math.atan2(velocity[1], velocity[0])
        add_along(out.covariance[k], axis, frozen.distance[0] ** 2)
        velocity *= min(duration / seconds, 1.0)  # from now on, every sweep is matched
    elif out.reasons[k] != PUSHED and out.located[k]:
        frozen.is_frozen[0] = False
    return _add_distance(state, seconds, out.located[k], settings.length)


@kernel
def _add_distance(state: State, seconds: float, located: bool, limit: float) -> bool:
    """Update the distance that the robot may have gone, at most `limit` m; see `notice_frozen`."""
    frozen, motion = state.frozen, state.motion
    before = frozen.distance[0] // SPACING
    if math.hypot(motion[0], motion[1]) > MAX_MOTION[0] or abs(motion[2]) > MAX_MOTION[1]:
        frozen.distance[0] = 0.0
        frozen.speed[0] = math.hypot(state.velocity[0], state.velocity[1]) / seconds
    elif located:
        frozen.distance[0] *= math.exp(-seconds / LONG_WINDOW)
    else:
        frozen.distance[0] = min(frozen.distance[0] + seconds * frozen.speed[0], limit)
    return bool(frozen.distance[0] // SPACING > before)
