"""Smooth the stamps of a device that works at a steady rate but is stamped on arrival."""

from __future__ import annotations

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array

_ALPHA = 0.1  # 1: gain of the phase; averages jitter over about ten sweeps
_BETA = _ALPHA**2 / 2.0  # 1: gain of the period; critically damped (Kalata 1984, tracking index)
_GAP = 50  # sweeps: after a longer pause, or a step back, the filter restarts
_PERIOD, _PHASE = 0, 1
"""Columns of the state: s between sweeps, and the smoothed stamp of the newest one, s."""


class SweepClock:
    """An alpha-beta filter on the phase of a steady clock.

    The mirror of a lidar turns at a constant rate, but the delay of its data in the serial line and the
    scheduler varies. At 2 rad/s a jitter of 30 ms is 3.4 degrees. Lost sweeps are taken into account.
    """

    def __init__(self, period: float) -> None:
        self._state = np.array([period, np.nan])

    def smooth(self, stamps: Array) -> Array:
        """Return the smoothed stamps (m,) in s of the next sweeps."""
        return _smooth(self._state, stamps)


@kernel
def _smooth(state: Array, stamps: Array) -> Array:
    """Return smoothed stamps (m,), and update the state (2,) in place."""
    smoothed = np.empty(len(stamps))
    for k in range(len(stamps)):
        period, phase = state[_PERIOD], state[_PHASE]
        lost = np.rint((stamps[k] - phase) / period) - 1.0
        if -2.0 < lost < _GAP:  # false for the first sweep
            predicted = phase + (1.0 + max(lost, 0.0)) * period
            error = stamps[k] - predicted
            state[_PHASE] = predicted + _ALPHA * error
            if lost <= 0.0:
                state[_PERIOD] += _BETA * error
        else:
            state[_PHASE] = stamps[k]
        smoothed[k] = state[_PHASE]
    return smoothed
