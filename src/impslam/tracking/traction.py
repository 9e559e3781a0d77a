"""Detect wheel slip: odometry that reports more acceleration than wheels can bring to the floor.

A wheel with traction accelerates the robot by mu g at most. If odometry gains more speed than that from
one sweep to the next, the wheels slip, and the robot keeps about the speed that it had. How far it then
went is uncertain by what odometry reports beyond that speed. Along a bare corridor no scan shows the
distance, so the covariance of the motion has to contain it. The motion itself stays as reported, because
readings that arrive in bunches look alike and add up to the right distance. Losing speed at any rate is no
slip: walls stop robots, and encoders that hang are detected by `odometry_check`.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import SLIPPED, Reasons
from impslam.noise import LEAST_UNKNOWN
from impslam.types import Array

MAX_ACCELERATION = 3.0
"""m/s^2, mu g: hard wheels on a smooth floor (mu = 0.3). Indoor robots are driven at 0.3 to 2 m/s^2."""
SIGMAS = 6.0
"""Times the usual rms excess, beyond that: readings come early or late, and where stamps are uneven, a
speed from sweep to sweep means nothing."""
INITIAL_RMS = 0.005
"""m, that rms before the first sweep: 10 ms at half a metre per second."""
MEMORY = 0.02
"""Weight of the newest sweep in its square: some seconds of most lidars."""
SLIP_TIMEOUT = 3.0
"""s after which a new speed is taken for the robot's, whatever caused it."""


class Traction:
    """Widens motions during which the wheels slip."""

    def __init__(self) -> None:
        # last speed, m/s; whether it is known; s and excess m since the slip began; mean square excess, m^2
        self._state = np.array([0.0, 0.0, 0.0, 0.0, INITIAL_RMS**2])

    def widen(self, duration: Array, d_pose: Array, covariance: Array) -> Reasons:
        """Widen, in place, the covariances (m, 3, 3) of motions (m, 3) that took `duration` (m,) s.

        Returns `SLIPPED` for those that were widened, else `NONE`, (m,).
        """
        return _widen(duration, d_pose, covariance, self._state)


@kernel
def _widen(duration: Array, d_pose: Array, covariance: Array, state: Array) -> Reasons:
    out = np.zeros(len(d_pose), np.int8)
    for k in range(len(d_pose)):
        seconds, distance = duration[k], d_pose[k, 0]
        if covariance[k, 0, 0] >= LEAST_UNKNOWN:
            state[1:4] = 0.0
        elif seconds > 0.0:
            excess = distance - state[0] * seconds
            if _slips(distance, excess, seconds, state):
                total = state[3] + excess
                covariance[k, 0, 0] += max(total**2 - state[3] ** 2, 0.0)
                state[2], state[3], out[k] = state[2] + seconds, total, SLIPPED
            else:
                if state[1] > 0.0:
                    state[4] += MEMORY * (excess * excess - state[4])
                state[0], state[1], state[2], state[3] = distance / seconds, 1.0, 0.0, 0.0
    return out


@kernel
def _slips(distance: float, excess: float, seconds: float, state: Array) -> bool:
    """Return whether `distance` m, of which `excess` is unexpected, starts or continues a slip."""
    if state[1] == 0.0 or state[2] + seconds >= SLIP_TIMEOUT:
        return False
    usual = SIGMAS * math.sqrt(state[4])
    begins = abs(excess) > MAX_ACCELERATION * seconds**2 + usual and abs(distance) > abs(
        excess - distance
    )
    return bool(begins or (state[2] > 0.0 and abs(excess) > usual))
