"""By how much the stamps of scans are late on the clock of odometry.

The turn from sweep to sweep by the laser, T_k, is that of odometry over the same time, R, shifted by the
lag: T_k = p (R(t_k - lag) - R(t_k-1 - lag)) + q S_k, S_k the way by odometry. A lag shows where turns begin
and end: the derivative by it is the change of the rate of turn from one sweep to the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.diagnosis.robust import CLEAR, Fit, fit
from impslam.diagnosis.travel import Laser, Odometer
from impslam.types import Array

LONGEST, STEP = 1.0, 0.05
"""s: lags that are looked for, and how finely: half of the quickest turn's beginning."""
RATE_OVER = 0.1
"""s over which a rate of turn is taken: the time from one reading to the next of slow odometry."""
BLOCK = 20
"""Sweeps after which errors no longer hang together: two seconds of most lidars."""
MOST = 4000
"""Sweeps that are used: thousands tell a lag to a millisecond."""
TURNING = 0.02
"""rad from sweep to sweep: ten times the error of a match. Others tell nothing of a lag, and are exact."""


class Lag(NamedTuple):
    """How late scans are stamped, in s, its standard deviation, and that of turns (rad) in the fit."""

    seconds: float
    sigma: float
    scale: float


def lag(motion: Laser, odometer: Odometer) -> Lag | None:
    """Return the lag of scans, whose stamps in `motion` are as received; None where no turn tells it."""
    rows = np.flatnonzero(motion.sure & (np.abs(motion.twists[:, 2]) > TURNING))[:MOST]
    before, after = motion.stamps[rows - 1], motion.stamps[rows]
    whole = odometer.is_whole(before - LONGEST, after + LONGEST)
    rows, before, after = rows[whole], before[whole], after[whole]
    if len(rows) < 5 * BLOCK:
        return None
    turns = motion.twists[rows, 2]
    tried = np.arange(-LONGEST, LONGEST + STEP, STEP)
    scales = [_fit(odometer, before - late, after - late, turns).scale for late in tried]
    late = float(tried[np.argmin(scales)])
    for _ in range(4):
        found = _fit(odometer, before - late, after - late, turns)
        if (
            abs(found.p[1]) <= CLEAR * found.sigma[1]
        ):  # it does not turn as the laser does, at any lag
            return None
        late -= float(np.clip(found.p[0] / found.p[1], -STEP, STEP))
    return Lag(late, float(found.sigma[0] / abs(found.p[1])), found.scale)


def _fit(odometer: Odometer, before: Array, after: Array, turns: Array) -> Fit:
    gone = odometer.until(after) - odometer.until(before)
    quicker = _rate(odometer, after) - _rate(odometer, before)
    return fit(np.column_stack((quicker, gone[:, 2], gone[:, 0])), turns, BLOCK)


def _rate(odometer: Odometer, times: Array) -> Array:
    """Return the rate of turn (k,) rad/s at times (k,)."""
    after, before = (
        odometer.until(times + half)[:, 2] for half in (0.5 * RATE_OVER, -0.5 * RATE_OVER)
    )
    return (after - before) / RATE_OVER
