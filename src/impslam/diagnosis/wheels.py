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
_NO_JUMPS = 0.0, 0


def check_wrap(e: Evidence) -> Iterator[Finding]:
    """Find encoders whose readings wrap although the config does not say so."""
    if not isinstance(e.odometry, Encoders) or not e.recording.odometry:
        return
    found = [
        _jumps(np.concatenate([np.asarray(c[side]) for c in e.recording.odometry]), e.odometry.wrap)
        for side in ("left", "right")
    ]
    size, count = max(found)
    wrap = _common_wrap(size, e.odometry.per_turn)
    if count > 1 or wrap:  # a single jump of another size is that of a counter that began anew
        yield Finding(
            "encoder wraps",
            f"readings of the wheels jump by {size:.6g} and continue: they wrap",
            (f"odometry.wrap={wrap or size:.9g}",),
            MAX_PROBABILITY,
        )


def _jumps(readings: Array, wrap: float) -> tuple[float, int]:
    """Return size and number of the jumps of readings (n,) that `wrap` does not explain; 0 without any."""
    readings = readings[np.isfinite(readings)]
    steps = np.diff(readings)
    if wrap:
        steps = steps - wrap * np.rint(steps / wrap)
    span = float(np.ptp(readings)) if len(steps) else 0.0
    jumps = np.abs(steps) > MIN_JUMP * span
    if not span or not jumps.any() or jumps.mean() > 0.1:
        return _NO_JUMPS
    low, high = np.percentile(readings, [10.0, 90.0])
    if high - low < MIN_FILLED * span:  # single outliers
        return _NO_JUMPS
    rest = steps[~jumps]
    if not len(rest) or np.abs(steps[jumps]).min() < MIN_JUMP_RATIO * np.abs(rest).max(initial=0.0):
        return _NO_JUMPS
    before = np.interp(np.flatnonzero(jumps), np.flatnonzero(~jumps), rest)
    sizes = np.abs(steps[jumps] - before)
    alike = np.ptp(sizes) <= SIZE_TOLERANCE * sizes.mean() + 2.0 * float(
        np.abs(rest).max(initial=0.0)
    )
    return (float(np.median(sizes)), len(sizes)) if alike else _NO_JUMPS


def _common_wrap(size: float, per_turn: float) -> float | None:
    """Return the common wrap (a power of two, one turn, ...) close to a size, if there is one."""
    common = [2.0**bits for bits in range(8, 33)] + [per_turn, 2.0 * math.pi, 360.0, 5.0, 10000.0]
    nearest = min(common, key=lambda one: abs(one - size))
    return nearest if abs(nearest - size) <= SIZE_TOLERANCE * size else None
