"""Estimate when scans were taken on the clock of odometry: their lag, and whether their stamps jitter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.calibration.order_clock import MAX_DISORDER
from impslam.diagnosis.finding import is_off
from impslam.diagnosis.lag import Lag, estimate_lag
from impslam.diagnosis.travel import Odometer, SweepMotions
from impslam.sensors.clock import SweepClock
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array

MAX_LAG_ERROR = 0.05
"""s: drivers stamp a scan at its beginning, end or arrival; at 1 rad/s it turns a scan by 3 degrees."""
MAX_JITTER_RATIO = 0.8
"""Ratio of the turns' residuals with smoothed stamps to those with the log's, below which the log's stamps
jitter: with a hundred turns this does not happen by chance (F-test, 1e-3)."""

MIN_REGULAR_STEP, SHORT_STEPS = 0.75, 0.1
"""Share of the median time between scans, and share of the times that is below it only if stamps jitter.
Lost scans make times longer, never shorter."""
SPAN = 10
"""Scans over which irregular times are averaged: jitter of half a period is then 5 % of it."""


class Timing(NamedTuple):
    """When scans were taken.

    Attributes
    ----------
    period : s, time between scans, see `scan_period`; 0 if unknown
    lag : lag of the scans by the stamps of the log; None if it cannot be determined
    smooth : the same with stamps of a steady rate
    is_late : whether the lag differs from the config by more than `tolerance`
    tolerance : s, lag that does no harm, or that stamps which run back could not correct
    jitter : s, rms difference of stamps from a steady rate; 0 if they run back
    stamps : (m,) s, the better stamps, on the clock of odometry
    """

    period: float
    lag: Lag | None
    smooth: Lag | None
    is_late: bool
    tolerance: float
    jitter: float
    stamps: Array

    @property
    def jitters(self) -> bool:
        """Whether stamps of a steady rate fit odometry clearly better."""
        return _is_better(self.smooth, self.lag)

    def fits_better(self, other: Timing) -> bool:
        """Return whether turns fit odometry clearly better than with another timing."""
        lag = other.smooth if other.jitters else other.lag
        return self.lag is not None and (lag is None or _is_better(self.lag, lag))


def _is_better(smooth: Lag | None, raw: Lag | None) -> bool:
    return smooth is not None and raw is not None and smooth.rms < MAX_JITTER_RATIO * raw.rms


def no_timing(motion: SweepMotions) -> Timing:
    """Return the timing of a log without usable stamps, whose times are by order."""
    return Timing(0.0, None, None, False, MAX_LAG_ERROR, 0.0, motion.stamps)


def scan_period(stamps: Array) -> float:
    """Return the usual time between scans with these stamps (m,), s; 0 if unknown.

    It is the median, as scans may be lost, unless stamps jitter: drivers that poll a serial line stamp
    scans of 0.2 s up to 0.1 s late, so that every other time is short.
    """
    steps = np.diff(stamps)
    steps = steps[steps > 0.0]
    if not len(steps):
        return 0.0
    period = float(np.median(steps))
    is_regular = np.quantile(steps, SHORT_STEPS) > MIN_REGULAR_STEP * period
    if is_regular or len(stamps) <= SPAN:
        return period
    return max(float(np.median(stamps[SPAN:] - stamps[:-SPAN])) / SPAN, 0.0)


def estimate_timing(
    motion: SweepMotions, odometer: Odometer, lidar: Lidar2D, disorder: float
) -> Timing:
    """Estimate when the scans of a laser's motions were taken.

    `disorder` is the amount by which the stamps of the log run back, s rms; above `MAX_DISORDER` the times
    must be those of `reorder_stamps`.
    """
    period, tolerance = scan_period(motion.stamps), max(MAX_LAG_ERROR, disorder)
    raw = estimate_lag(motion, odometer) if len(odometer.stamps) and period else None
    if raw is None:
        return Timing(period, None, None, False, tolerance, 0.0, motion.stamps - lidar.latency)
    smooth, steady = None, motion.stamps
    if not lidar.period and disorder <= MAX_DISORDER:
        steady = SweepClock(period).smooth(np.ascontiguousarray(motion.stamps))
        smooth = estimate_lag(motion._replace(stamps=steady), odometer)
    jitter = float(np.std(motion.stamps - steady))
    if smooth is not None and _is_better(smooth, raw):
        return Timing(period, raw, smooth, False, tolerance, jitter, steady - smooth.seconds)
    off = raw.seconds - lidar.latency
    shift = raw.seconds if is_off(off, raw.sigma, MAX_LAG_ERROR) else lidar.latency
    is_late = is_off(off, raw.sigma, tolerance)
    return Timing(period, raw, smooth, is_late, tolerance, jitter, motion.stamps - shift)
