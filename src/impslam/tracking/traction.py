"""Whether odometry tells of more acceleration than wheels can bring to the floor: then they spin.

A wheel on the floor speeds the robot up by mu g at most. Where odometry gains more speed than that from
one sweep to the next, the wheels have lost the floor, and the robot goes on with about the speed that it
had. How far it went meanwhile is known to what odometry tells beyond that: along a bare corridor no scan
shows it, so it has to be in the covariance of the motion. The motion itself stays as told, because readings
that come in bunches look alike and add up to the right way. Losing speed at any rate is no slip: walls stop
robots, and encoders that hang are found by `check`.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import SLIPPED, Reasons
from impslam.noise import UNKNOWN
from impslam.types import Array

TRACTION = 3.0
"""m/s^2, mu g: hard wheels on a smooth floor (mu = 0.3). Indoor robots are driven at 0.3 to 2 m/s^2."""
SIGMAS = 6.0
"""Times the rms of what ways are usually odd by, beyond that: readings come early or late, and where stamps
are uneven a speed from sweep to sweep tells nothing."""
USUAL = 0.005
"""m, that rms before the first sweep: 10 ms at half a metre per second."""
MEMORY = 0.02
"""Weight of the newest sweep in its square: some seconds of most lidars."""
LONGEST = 3.0
"""s after which another speed is the robot's, by whatever it was brought to it."""


class Traction:
    """Widens motions during which the wheels have lost the floor."""

    def __init__(self) -> None:
        # speed before, m/s; whether it is known; s and m since the wheels spin; m^2 usually odd
        self._state = np.array([0.0, 0.0, 0.0, 0.0, USUAL**2])

    def widen(self, duration: Array, d_pose: Array, covariance: Array) -> Reasons:
        """Widen in place the covariances (m, 3, 3) of motions (m, 3) of so many s (m,).

        Returns `SLIPPED` where that was necessary, else `NONE`, (m,).
        """
        return _widen(duration, d_pose, covariance, self._state)


@kernel
def _widen(duration: Array, d_pose: Array, covariance: Array, state: Array) -> Reasons:
    out = np.zeros(len(d_pose), np.int8)
    for k in range(len(d_pose)):
        seconds, way = duration[k], d_pose[k, 0]
        if covariance[k, 0, 0] >= 0.5 * UNKNOWN:
            state[1:4] = 0.0
        elif seconds > 0.0:
            excess = way - state[0] * seconds
            if _slips(way, excess, seconds, state):
                gone = state[3] + excess
                covariance[k, 0, 0] += max(gone**2 - state[3] ** 2, 0.0)
                state[2], state[3], out[k] = state[2] + seconds, gone, SLIPPED
            else:
                if state[1] > 0.0:
                    state[4] += MEMORY * (excess * excess - state[4])
                state[0], state[1], state[2], state[3] = way / seconds, 1.0, 0.0, 0.0
    return out


@kernel
def _slips(way: float, excess: float, seconds: float, state: Array) -> bool:
    """Tell whether a way of so many m, of which some are in excess, begins a slip or goes on with one."""
    if state[1] == 0.0 or state[2] + seconds >= LONGEST:
        return False
    usual = SIGMAS * math.sqrt(state[4])
    begins = abs(excess) > TRACTION * seconds**2 + usual and abs(way) > abs(excess - way)
    return bool(begins or (state[2] > 0.0 and abs(excess) > usual))
