"""Estimate by how much the stamps of scans are late on the clock of odometry.

The turn from sweep to sweep by the laser, T_k, is that of odometry over the same time, R, shifted by the
lag: T_k = p (R(t_k - lag) - R(t_k-1 - lag)) + q S_k + r (t_k - t_k-1), with S_k the distance by odometry. A
lag is visible where turns begin and end: the derivative by it is the change of the turn rate from one sweep
to the next. A constant turn rate fits at any lag: r leaves p undetermined then.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.diagnosis.robust import CLEAR, fit
from impslam.diagnosis.travel import Odometer, SweepMotions
from impslam.odometry.synchroniser import MAX_DELAY
from impslam.types import Array, Ints

MAX_LAG, LAG_STEP = 1.0, 0.05
"""s: range and step of the search: half of the time in which the quickest turn begins."""
RATE_INTERVAL = 0.1
"""s over which a turn rate is computed: the time between two readings of slow odometry."""
MAX_READING_PERIOD = 0.6
"""s, median time between readings of odometry: turns take a second, so between rarer readings they seem to
begin and end up to a tenth of a second off."""
BLOCK = 20
"""Sweeps after which errors are uncorrelated: two seconds of most lidars."""
MAX_SWEEPS = 4000
"""Sweeps that are used: thousands determine a lag to a millisecond."""
MIN_TURN, NEIGHBOURS = 0.02, 5
"""rad from sweep to sweep, ten times the error of a match; and sweeps on either side of such a turn that
are used too. Other sweeps contain no information on a lag."""
MAX_RESIDUAL = 0.1
"""rad at which residuals are clipped: larger ones come from slip or a wrong match."""
MATCH_ERROR = 0.002
"""rad: error of a match."""


class Lag(NamedTuple):
    """Lag of the scans' stamps and its standard deviation, s; rms of the turns' residuals, rad."""

    seconds: float
    sigma: float
    rms: float


def estimate_lag(motion: SweepMotions, odometer: Odometer) -> Lag | None:
    """Return the lag of scans with stamps as received; None if there are too few turns or readings."""
    steps = np.diff(odometer.stamps)
    if not len(steps) or np.median(steps) > MAX_READING_PERIOD:
        return None
    found = _search(motion, odometer, MAX_LAG)
    if found is not None and abs(found.seconds) < MAX_LAG - LAG_STEP:
        return found
    return _search(motion, odometer, MAX_DELAY) or found


def _search(motion: SweepMotions, odometer: Odometer, largest: float) -> Lag | None:
    """Return the lag within `largest` s of 0; None if odometry is uncorrelated with the laser there."""
    rows = _turning(motion)
    before, after = motion.stamps[rows - 1], motion.stamps[rows]
    whole = odometer.is_whole(before - largest, after + largest)
    rows, before, after = rows[whole], before[whole], after[whole]
    if len(rows) < 5 * BLOCK:
        return None
    turns = motion.twists[rows, 2]
    lags = np.arange(-largest, largest + LAG_STEP, LAG_STEP)
    errors = [_rms(_rows(odometer, before - late, after - late), turns) for late in lags]
    late = float(lags[np.argmin(errors)])
    for _ in range(4):
        A = _rows(odometer, before - late, after - late)
        found = fit(A, turns, BLOCK, MATCH_ERROR)
        if abs(found.p[1]) <= CLEAR * found.sigma[1]:  # uncorrelated with the laser at any lag
            return None
        late -= float(np.clip(found.p[0] / found.p[1], -LAG_STEP, LAG_STEP))
    rms = _rms(_rows(odometer, before - late, after - late), turns)
    return Lag(late, float(found.sigma[0] / abs(found.p[1])), rms)


def _turning(motion: SweepMotions) -> Ints:
    """Return the rows of sweeps in or near turns."""
    turns = motion.known & (np.abs(motion.twists[:, 2]) > MIN_TURN)
    near = (
        np.convolve(turns, np.ones(2 * NEIGHBOURS + 1))[NEIGHBOURS : NEIGHBOURS + len(turns)] > 0.5
    )
    return np.flatnonzero(motion.known & near)[:MAX_SWEEPS]


def _rms(A: Array, turns: Array) -> float:
    """Return the rms of the clipped residuals of a least-squares fit."""
    inside = np.ones(len(turns), np.bool_)
    for _ in range(3):
        p = np.asarray(np.linalg.lstsq(A[inside], turns[inside], rcond=None)[0])
        off = np.abs(turns - A @ p)
        inside = off < MAX_RESIDUAL
        if inside.sum() <= A.shape[1]:
            break
    return float(np.sqrt(np.mean(np.square(np.minimum(off, MAX_RESIDUAL)))))


def _rows(odometer: Odometer, before: Array, after: Array) -> Array:
    """Return (m, 4): the derivative by the lag, the turn and the distance by odometry, and the time."""
    half = 0.5 * RATE_INTERVAL
    times = before, after, before - half, before + half, after - half, after + half
    sums = odometer.at(np.concatenate(times)).reshape(len(times), -1, 3)
    begin, end, begin_low, begin_high, end_low, end_high = sums
    motion = end - begin
    begin_rate = (begin_high - begin_low)[:, 2] / RATE_INTERVAL
    end_rate = (end_high - end_low)[:, 2] / RATE_INTERVAL
    return np.column_stack((end_rate - begin_rate, motion[:, 2], motion[:, 0], after - before))
