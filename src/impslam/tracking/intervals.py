"""The usual time between the sweeps of a log, and gaps, which are much longer.

Some logs keep a scan every few seconds, and some computers stamp scans in bursts, so a fixed limit does not
tell a gap.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array

GAP_FACTOR, GAP_SIGMAS = 3.0, 6.0
"""Times the mean interval, and standard deviations above it, that a gap exceeds. If sweeps come at random
times, one interval in 1000 exceeds the latter."""
MEMORY = 0.01
"""Weight of the newest interval in the means: 100 sweeps."""


def no_intervals() -> Array:
    """Return the statistics (3,) before the first interval: number, mean in s, mean square in s^2."""
    return np.zeros(3)


@kernel
def is_gap(seconds: float, intervals: Array, least: float) -> bool:
    """Return whether an interval is a gap: longer than `least` s, and than the usual ones by far."""
    return seconds > _longest(intervals, least)


@kernel
def add_interval(seconds: float, intervals: Array, least: float) -> None:
    """Update the statistics (3,) with an interval, a gap as one of the longest that is none."""
    if intervals[0] > 0.0:
        seconds = min(seconds, _longest(intervals, least))
    intervals[0] += 1.0
    weight = max(MEMORY, 1.0 / intervals[0])
    intervals[1] += weight * (seconds - intervals[1])
    intervals[2] += weight * (seconds * seconds - intervals[2])


@kernel
def _longest(intervals: Array, least: float) -> float:
    mean = intervals[1]
    sigma = math.sqrt(max(intervals[2] - mean * mean, 0.0))
    return float(max(least, GAP_FACTOR * mean, mean + GAP_SIGMAS * sigma))
