"""Estimate when scans were taken on the clock of odometry: their lag, and whether their stamps jitter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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


class Timing(NamedTuple):
    """When scans were taken.

    Attributes
    ----------
    period : s, median time between scans; 0 if unknown
    lag : lag of the scans by the stamps of the log; None if it cannot be determined
    smooth : the same with stamps of a steady rate
    is_late : whether the lag differs from the config
    jitter : s, rms difference of stamps from a steady rate
    stamps : (m,) s, the better stamps, on the clock of odometry
    """

    period: float
    lag: Lag | None
    smooth: Lag | None
    is_late: bool
    jitter: float
    stamps: Array

    @property
    def jitters(self) -> bool:
        """Whether stamps of a steady rate fit odometry clearly better."""
        return _is_better(self.smooth, self.lag)


def _is_better(smooth: Lag | None, raw: Lag | None) -> bool:
    return smooth is not None and raw is not None and smooth.rms < MAX_JITTER_RATIO * raw.rms


def no_timing(motion: SweepMotions) -> Timing:
    """Return the timing of a log without usable stamps, whose times are by order."""
    return Timing(0.0, None, None, False, 0.0, motion.stamps)


def estimate_timing(motion: SweepMotions, odometer: Odometer, lidar: Lidar2D) -> Timing:
    """Estimate when the scans of a laser's motions were taken."""
    steps = np.diff(motion.stamps)
    period = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if not len(odometer.stamps) or not period:
        return Timing(period, None, None, False, 0.0, motion.stamps - lidar.latency)
    raw, smooth, steady = estimate_lag(motion, odometer), None, motion.stamps
    if not lidar.period and raw is not None:
        steady = SweepClock(period).smooth(np.ascontiguousarray(motion.stamps))
        smooth = estimate_lag(motion._replace(stamps=steady), odometer)
    jitter = float(np.std(motion.stamps - steady))
    if smooth is not None and _is_better(smooth, raw):
        return Timing(period, raw, smooth, False, jitter, steady - smooth.seconds)
    is_late = raw is not None and is_off(raw.seconds - lidar.latency, raw.sigma, MAX_LAG_ERROR)
    shift = raw.seconds if raw is not None and is_late else lidar.latency
    return Timing(period, raw, smooth, is_late, jitter, motion.stamps - shift)
