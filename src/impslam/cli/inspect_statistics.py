"""Statistics of the stamps and the scans of a log."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field

import numpy as np

from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, LaserScan

MIN_BEAMS = 10
"""Number of valid beams that a scan needs to be matched."""
FULL_TURN_STEPS = 1.5
"""Steps from the last beam to the first of a full turn: one, in theory; drivers round the step."""


@dataclass(slots=True)
class StampStatistics:
    """Statistics of the stamps of one message type."""

    count: int = 0
    first: float = math.nan
    last: float = math.nan
    backward: int = 0
    repeated: int = 0
    gap: float = 0.0
    _previous: float = math.nan

    def add(self, stamp: float) -> None:
        """Add a stamp."""
        step = stamp - self._previous
        self.backward += step < 0.0
        self.repeated += step == 0.0
        self.gap = max(self.gap, step)  # unchanged if step is NaN
        self.first, self.last = min(stamp, self.first), max(stamp, self.last)
        if self.count == 0:
            self.first = self.last = stamp
        self.count, self._previous = self.count + 1, stamp

    @property
    def duration(self) -> float:
        """Time from the first to the last stamp, s."""
        return self.last - self.first

    @property
    def rate(self) -> float:
        """Messages per second; NaN for a single message."""
        return (self.count - 1) / self.duration if self.duration > 0.0 else math.nan


@dataclass(slots=True)
class ScanGeometry:
    """The geometry of the scans; `poor` ones have few valid beams, `blind` ones none.

    `limits` and `given` are the limits of the ranges in the messages and in the config, NaN if unset.
    """

    counts: dict[int, int] = field(default_factory=dict)
    starts: set[float] = field(default_factory=set)
    field_of_view: float = 0.0
    limits: tuple[float, float] = (math.nan, math.nan)
    given: tuple[float, float] = (math.nan, math.nan)
    nearest: float = math.inf
    farthest: float = 0.0
    sweeps: list[float] = field(default_factory=list)
    total: int = 0
    invalid: int = 0
    scans: int = 0
    poor: int = 0
    blind: int = 0

    def add(self, scan: LaserScan, lidar: Lidar2D | None) -> None:
        """Add a scan; the lidar of the config, if any, decides which beams are valid."""
        n = len(scan.ranges)
        self.counts[n] = self.counts.get(n, 0) + 1
        self.limits = scan.range_min, scan.range_max
        if n == 0:
            return
        self.starts.add(round(float(scan.angles[0]), 4))
        self.field_of_view = _field_of_view(scan.angles)
        self.sweeps.append(float(scan.time_offsets.max()))
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(scan.ranges) & (scan.ranges > 0.0)
        if lidar is not None:
            valid = lidar.scan(scan, np.zeros(3)).valid
            self.given = lidar.range_min, lidar.range_max
        count = int(valid.sum())
        self.total, self.invalid = self.total + n, self.invalid + n - count
        self.scans, self.poor = self.scans + 1, self.poor + (0 < count < MIN_BEAMS)
        self.blind += count == 0
        if valid.any():
            self.nearest = min(self.nearest, float(scan.ranges[valid].min()))
            self.farthest = max(self.farthest, float(scan.ranges[valid].max()))

    @property
    def sweep(self) -> float:
        """Median duration of a sweep, s: drivers that measure it double it when they lose a scan."""
        return statistics.median(self.sweeps) if self.sweeps else 0.0

    @property
    def share_invalid(self) -> float:
        """Share of invalid beams."""
        return self.invalid / self.total if self.total else 0.0


def _field_of_view(angles: Array) -> float:
    """Return the angle between the first and the last beam, or 2 pi if they are neighbours, rad."""
    span, full = float(np.ptp(angles)), 2.0 * math.pi
    step = span / max(len(angles) - 1, 1)
    return full if span + FULL_TURN_STEPS * step >= full else span
