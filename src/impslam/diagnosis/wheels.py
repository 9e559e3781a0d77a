"""Check wheel readings for encoders that wrap."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import MAX_PROBABILITY, Finding
from impslam.odometry.encoders import Encoders
from impslam.types import Array

MIN_JUMP = 0.5
"""Smallest step at a wrap, as a share of the range of the wheel's readings."""
MIN_FILLED = 0.2
"""Smallest share of that range that the middle 80 % of the readings cover. Less are single outliers."""
MIN_JUMP_RATIO = 5.0
"""Ratio of the smallest jump to the largest step in the rest of the log."""
SIZE_TOLERANCE = 0.02
"""Share by which an estimated wrap may differ from a common one and still be rounded to it."""


def check_wrap(e: Evidence) -> Iterator[Finding]:
    """Find encoders whose readings wrap although the config does not say so."""
    if not isinstance(e.odometry, Encoders) or not e.recording.odometry:
        return
    found = [
        _wrap(np.concatenate([np.asarray(c[side]) for c in e.recording.odometry]), e.odometry.wrap)
        for side in ("left", "right")
    ]
    size = max(found)
    if size > 0.0:
        wrap = _common_wrap(size, e.odometry.per_turn)
        yield Finding(
            "encoder wraps",
            f"readings of the wheels jump by {size:.6g} and continue: they wrap",
            (f"odometry.wrap={wrap:.9g}",),
            MAX_PROBABILITY,
        )


def _wrap(readings: Array, wrap: float) -> float:
    """Return the size of the jumps of readings (n,) that `wrap` does not explain; 0 if there are none."""
    readings = readings[np.isfinite(readings)]
    steps = np.diff(readings)
    if wrap:
        steps = steps - wrap * np.rint(steps / wrap)
    span = float(np.ptp(readings)) if len(steps) else 0.0
    jumps = np.abs(steps) > MIN_JUMP * span
    if not span or not jumps.any() or jumps.mean() > 0.1:
        return 0.0
    low, high = np.percentile(readings, [10.0, 90.0])
    if high - low < MIN_FILLED * span:  # single outliers
        return 0.0
    rest = steps[~jumps]
    if not len(rest) or np.abs(steps[jumps]).min() < MIN_JUMP_RATIO * np.abs(rest).max(initial=0.0):
        return 0.0
    before = np.interp(np.flatnonzero(jumps), np.flatnonzero(~jumps), rest)
    sizes = np.abs(steps[jumps] - before)
    alike = np.ptp(sizes) <= SIZE_TOLERANCE * sizes.mean() + 2.0 * float(
        np.abs(rest).max(initial=0.0)
    )
    return float(np.median(sizes)) if alike else 0.0


def _common_wrap(size: float, per_turn: float) -> float:
    """Return the common wrap (a power of two, one turn, ...) close to a size, or the size itself."""
    common = [2.0**bits for bits in range(8, 33)] + [per_turn, 2.0 * math.pi, 360.0, 5.0, 10000.0]
    nearest = min(common, key=lambda one: abs(one - size))
    return nearest if abs(nearest - size) <= SIZE_TOLERANCE * size else size
