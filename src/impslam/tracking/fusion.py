"""Fuse matches with the prior, and predict without odometry: the motion model of scan matching."""

from __future__ import annotations

import numpy as np

from impslam.geometry.algebra import invert
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.tracking.match_information import add_along
from impslam.tracking.matching_state import DISTANCE, SECONDS, TURN, Settings, State
from impslam.types import Array

MIN_MOTION = (0.05, 0.04)
"""m, rad: motion by odometry after which a scan is matched. Matching closer scans gains nothing, and
matching every 10 cm costs a fifth of the accuracy."""
MIN_SLIP = (0.1, 0.025)
"""m, rad: a smaller difference from odometry is no slip, however certain odometry is."""
MIN_SIGMA = 1e-4
"""m, rad: smallest standard deviation of a match."""
SPEED_SIGMA, RATE_SIGMA = 0.3, 0.6
"""m/s, rad/s: change of velocity from scan to scan for a robot without odometry: half of walking pace; 0.2
to 0.5 m/s work equally well."""
MAX_COAST = 1.0
"""s: bound of the time between scans, whose stamps may jump; its lower bound is the mean, as they may also
stand still."""


@kernel
def fuse(
    state: State, settings: Settings, guess: Array, H: Array, W: Array, covariance: Array
) -> None:
    """Fuse the best match with the prior: update the pose and `state.error`.

    The motion since the last match then adds no error of its own: its `covariance` (3, 3) becomes zero. It
    stays as it is if there is no solution.

    Errors of successive matches are correlated: surfaces look different from different positions, and
    grass, ramps and people move along. So a match is at best as certain as D, the drift of matched motion
    since the last match, however many points it has: its information is (H^-1 + D)^-1. That and its
    product with the best match are written with A = (H + D^-1)^-1, since H has no inverse along a
    corridor.
    """
    distance = state.travelled[DISTANCE] + MIN_MOTION[0]
    turn = state.travelled[TURN] + MIN_MOTION[1]
    d = np.empty(3)
    d[0] = d[1] = 1.0 / (max(settings.drift[0], settings.drift[1]) ** 2 * distance + MIN_SIGMA**2)
    d[2] = 1.0 / (settings.drift[2] ** 2 * distance + settings.drift[3] ** 2 * turn + MIN_SIGMA**2)
    A, pull, step = H.copy(), np.empty(3), np.empty(3)
    for a in range(3):
        A[a, a] += d[a]
    if not invert(A):
        return
    pull[0], pull[1] = W[0] * (state.pose[0] - guess[0]), W[1] * (state.pose[1] - guess[1])
    pull[2] = W[2] * wrap_in_kernel(state.pose[2] - guess[2])
    posterior = np.empty((3, 3))
    for a in range(3):
        step[a] = d[a] * (A[a, 0] * pull[0] + A[a, 1] * pull[1] + A[a, 2] * pull[2]) - pull[a]
        for b in range(3):
            posterior[a, b] = -d[a] * A[a, b] * d[b]
        posterior[a, a] += d[a] + W[a]
    if invert(posterior):
        gain = posterior * W
        state.error[:] = gain @ state.error @ gain.T + posterior
        covariance[:] = 0.0
        step = posterior @ step
        state.pose[0] += step[0]
        state.pose[1] += step[1]
        state.pose[2] = wrap_in_kernel(state.pose[2] + step[2])


@kernel
def coast(state: State, located: bool, weakest: float, axis: float) -> None:
    """Widen the error of a match after motion at constant velocity along the axis of least information.

    The velocity may be off by `SPEED_SIGMA` while no scan determines it, and the position by that times the
    elapsed time. A scan of information `weakest` along the axis shortens the time by its Kalman gain.
    """
    seconds = min(state.travelled[SECONDS], MAX_COAST)
    odds = max(weakest, 0.0) * (SPEED_SIGMA * seconds) ** 2
    state.unlocated[0] = (state.unlocated[0] + seconds) / (1.0 + odds)
    if not located:
        state.faults.unlocated[0] = max(state.faults.unlocated[0], SPEED_SIGMA * state.unlocated[0])
    variance = 2.0 * SPEED_SIGMA**2 * state.unlocated[0] * seconds
    add_along(state.error, axis, variance)
