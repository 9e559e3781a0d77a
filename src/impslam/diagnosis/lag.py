"""By how much the stamps of scans are late on the clock of odometry.

The turn from sweep to sweep by the laser, T_k, is that of odometry over the same time, R, shifted by the
lag: T_k = p (R(t_k - lag) - R(t_k-1 - lag)) + q S_k, S_k the way by odometry. A lag shows where turns begin
and end: the derivative by it is the change of the rate of turn from one sweep to the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.diagnosis.robust import CLEAR, fit
from impslam.diagnosis.travel import Laser, Odometer
from impslam.types import Array, Ints

LONGEST, STEP = 1.0, 0.05
"""s: lags that are looked for, and how finely: half of the quickest turn's beginning."""
RATE_OVER = 0.1
"""s over which a rate of turn is taken: the time from one reading to the next of slow odometry."""
BLOCK = 20
"""Sweeps after which errors no longer hang together: two seconds of most lidars."""
MOST = 4000
"""Sweeps that are used: thousands tell a lag to a millisecond."""
TURNING, NEAR = 0.02, 5
"""rad from sweep to sweep, ten times the error of a match; and sweeps on either side of one that turns so
much. Others tell nothing of a lag."""
WRONG = 0.1
"""rad: a residual that is larger counts as much, be it of a slip or of a wrong match."""
MATCH = 0.002
"""rad: error of a match."""


class Lag(NamedTuple):
    """How late scans are stamped and its standard deviation, s; rms of the turns' residuals, rad."""

    seconds: float
    sigma: float
    rms: float


def lag(motion: Laser, odometer: Odometer) -> Lag | None:
    """Return the lag of scans, whose stamps in `motion` are as received; None where no turn tells it."""
    rows = _turning(motion)
    before, after = motion.stamps[rows - 1], motion.stamps[rows]
    whole = odometer.is_whole(before - LONGEST, after + LONGEST)
    rows, before, after = rows[whole], before[whole], after[whole]
    if len(rows) < 5 * BLOCK:
        return None
    turns = motion.twists[rows, 2]
    tried = np.arange(-LONGEST, LONGEST + STEP, STEP)
    errors = [_rms(_rows(odometer, before - late, after - late), turns) for late in tried]
    late = float(tried[np.argmin(errors)])
    for _ in range(4):
        A = _rows(odometer, before - late, after - late)
        found = fit(A, turns, BLOCK, MATCH)
        if (
            abs(found.p[1]) <= CLEAR * found.sigma[1]
        ):  # it does not turn as the laser does, at any lag
            return None
        late -= float(np.clip(found.p[0] / found.p[1], -STEP, STEP))
    rms = _rms(_rows(odometer, before - late, after - late), turns)
    return Lag(late, float(found.sigma[0] / abs(found.p[1])), rms)


def _turning(motion: Laser) -> Ints:
    """Return the rows of sweeps near which the laser turns."""
    turns = motion.sure & (np.abs(motion.twists[:, 2]) > TURNING)
    near = np.convolve(turns, np.ones(2 * NEAR + 1))[NEAR : NEAR + len(turns)] > 0.5
    return np.flatnonzero(motion.sure & near)[:MOST]


def _rms(A: Array, turns: Array) -> float:
    """Return the rms of the bounded errors that least squares leaves."""
    inside = np.ones(len(turns), np.bool_)
    for _ in range(3):
        p = np.asarray(np.linalg.lstsq(A[inside], turns[inside], rcond=None)[0])
        off = np.abs(turns - A @ p)
        inside = off < WRONG
        if inside.sum() <= A.shape[1]:
            break
    return float(np.sqrt(np.mean(np.square(np.minimum(off, WRONG)))))


def _rows(odometer: Odometer, before: Array, after: Array) -> Array:
    """Return (m, 3): the derivative by the lag, the turn, and the way by odometry."""
    gone = odometer.until(after) - odometer.until(before)
    quicker = _rate(odometer, after) - _rate(odometer, before)
    return np.column_stack((quicker, gone[:, 2], gone[:, 0]))


def _rate(odometer: Odometer, times: Array) -> Array:
    """Return the rate of turn (k,) rad/s at times (k,)."""
    half = 0.5 * RATE_OVER
    return (odometer.until(times + half) - odometer.until(times - half))[:, 2] / RATE_OVER
