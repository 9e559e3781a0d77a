"""What is wrong with the readings of wheels themselves: encoders that wrap."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import SUREST, Finding
from impslam.odometry.encoders import Encoders
from impslam.types import Array

JUMP = 0.5
"""Share of all values of a wheel that a step is across where its reading wraps."""
FILLED = 0.2
"""Share of all values that four fifths of the readings take up: they come round, or lie at both ends."""
USUAL = 5.0
"""Times a step's size in the rest of the log that a jump is larger."""
NEAR = 0.02
"""Share by which an estimated wrap may differ from a usual one to be taken for it."""


def wheels(e: Evidence) -> Iterator[Finding]:
    """Find encoders whose readings wrap without the config saying so."""
    if not isinstance(e.odometry, Encoders) or not e.recording.odometry:
        return
    found = [
        _wrap(np.concatenate([np.asarray(c[side]) for c in e.recording.odometry]), e.odometry.wrap)
        for side in ("left", "right")
    ]
    size = max(found)
    if size > 0.0:
        wrap = _usual(size, e.odometry.per_turn)
        yield Finding(
            "encoder wraps",
            f"readings of the wheels jump by {size:.6g} and continue: they wrap",
            (f"odometry.wrap={wrap:.9g}",),
            SUREST,
        )


def _wrap(readings: Array, wrap: float) -> float:
    """Return by how much readings (n,) jump where they wrap, beyond `wrap`; 0 if they do not."""
    readings = readings[np.isfinite(readings)]
    steps = np.diff(readings)
    if wrap:
        steps = steps - wrap * np.rint(steps / wrap)
    span = float(np.ptp(readings)) if len(steps) else 0.0
    jumps = np.abs(steps) > JUMP * span
    if not span or not jumps.any() or jumps.mean() > 0.1:
        return 0.0
    low, high = np.percentile(readings, [10.0, 90.0])
    if high - low < FILLED * span:  # single readings that are wrong, and back again
        return 0.0
    rest = steps[~jumps]
    if not len(rest) or np.abs(steps[jumps]).min() < USUAL * np.abs(rest).max(initial=0.0):
        return 0.0
    before = np.interp(np.flatnonzero(jumps), np.flatnonzero(~jumps), rest)
    sizes = np.abs(steps[jumps] - before)
    alike = np.ptp(sizes) <= NEAR * sizes.mean() + 2.0 * float(np.abs(rest).max(initial=0.0))
    return float(np.median(sizes)) if alike else 0.0


def _usual(size: float, per_turn: float) -> float:
    """Return the power of two, or the turn, that a wrap is near to; itself if to none."""
    known = [2.0**bits for bits in range(8, 33)] + [per_turn, 2.0 * math.pi, 360.0, 5.0, 10000.0]
    near = min(known, key=lambda one: abs(one - size))
    return near if abs(near - size) <= NEAR * size else size
