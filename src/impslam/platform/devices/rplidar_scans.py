"""Make scans of an RPLidar's turns: split at the start bit, stamp, and resample evenly."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from impslam.platform.devices.lower_hull import edge_at_mean
from impslam.platform.devices.rplidar_protocol import Nodes
from impslam.types import Array, LaserScan

WINDOW = 6.0  # s of the fit of the sampling rate; some arrivals are on time on any computer
SPACING = 0.02  # s between the points of the fit
RECENT_SPAN = 1.0  # s
MAX_TURN_ERROR = 0.6  # rad between a turn and a full one: near targets shift angles by 8 deg
MAX_LATENESS = 0.03  # s; if all recent arrivals are later, bytes were lost without notice


@dataclass(frozen=True, slots=True, eq=False)
class Revolution:
    """The measurements of one turn: n of `slots` expected ones.

    `first` is the number of the turn's first measurement in the stream, `numbers` (n,) count from it;
    angles (n,) rad clockwise, ranges (n,) m, qualities (n,) or None.
    """

    first: int
    slots: int
    numbers: Array
    angles: Array
    ranges: Array
    qualities: Array | None


class Turns:
    """Splits nodes into whole turns; `broken` counts those that are not one turn long."""

    def __init__(self) -> None:
        self._parts: list[Nodes] = []
        self.broken = 0

    def add(self, nodes: Nodes) -> list[Revolution]:
        """Add nodes and return the turns that they complete."""
        cuts = np.flatnonzero(nodes.starts).tolist()
        turns = []
        begin = 0
        for cut in cuts:
            self._parts.append(_slice(nodes, begin, cut))
            turn = self._end_turn(nodes.first + cut)
            turns += [turn] if turn is not None else []
            begin = cut
        self._parts.append(_slice(nodes, begin, len(nodes.starts)))
        if not cuts and (self._parts[-1].first - self._parts[0].first) > 2**16:
            self._parts.clear()  # the head does not turn, or the start bit is missing
            self.broken += 1
        return turns

    def _end_turn(self, end: int) -> Revolution | None:
        """Return the turn that ends before a number; None if it has no start or is broken."""
        parts, self._parts = [part for part in self._parts if len(part.starts)], []
        if not parts or not parts[0].starts[0]:
            return None
        first = parts[0].first
        angles = np.concatenate([part.angles for part in parts])
        turned = np.unwrap(angles)[-1] - angles[0] if len(angles) else 0.0
        if abs(turned - 2.0 * math.pi) > MAX_TURN_ERROR or first >= end:
            self.broken += 1
            return None
        numbers = [part.first - first + np.arange(len(part.starts)) for part in parts]
        qualities = [part.qualities for part in parts if part.qualities is not None]
        return Revolution(
            first,
            end - first,
            np.concatenate(numbers).astype(np.float64),
            angles,
            np.concatenate([part.ranges for part in parts]),
            np.concatenate(qualities) if qualities else None,
        )


def _slice(nodes: Nodes, begin: int, end: int) -> Nodes:
    qualities = nodes.qualities
    return Nodes(
        nodes.first + begin,
        nodes.starts[begin:end],
        nodes.angles[begin:end],
        nodes.ranges[begin:end],
        None if qualities is None else qualities[begin:end],
    )


class NodeClock:
    """Estimates the times of measurements from their numbers and the arrivals of their bytes.

    The lidar has no clock, but measures at a constant rate. Bytes arrive with varying delays, never
    early: of all lines (time over number) below the arrivals, the one with the least mean delay is
    taken. It is the edge of the arrivals' lower convex hull at their mean (Zhang, Liu & Xia 2002), and
    correct except for the minimum delay.
    """

    def __init__(self) -> None:
        self._points: deque[tuple[int, float]] = deque()

    def observe(self, number: int, arrived: float) -> None:
        """Record that all measurements before this number had arrived at a host time, s."""
        points = self._points
        last, when = points[-1] if points else (0, -math.inf)
        if number <= last or arrived - when < SPACING:
            return  # nothing new: the scan has not begun, or arrives in bursts
        points.append((number, arrived))
        while arrived - points[0][1] > WINDOW:
            points.popleft()

    def fit(self) -> tuple[float, float] | None:
        """Return (s at number 0, s per measurement); None before half a second of arrivals."""
        line = self._line()
        if line is not None and self._min_lateness(*line) > MAX_LATENESS:
            points = self._points  # bytes were lost without notice: drop the points before
            while points[-1][1] - points[0][1] > RECENT_SPAN:
                points.popleft()
            line = self._line()
        return line

    def _line(self) -> tuple[float, float] | None:
        points = self._points
        if len(points) < 4 or points[-1][1] - points[0][1] < 0.5 * RECENT_SPAN:
            return None
        zero, origin = points[-1]  # relative to the last point, for precision
        edge = edge_at_mean([(n - zero, t - origin) for n, t in points])
        assert edge is not None  # numbers increase
        (n0, t0), (n1, t1) = edge
        period = (t1 - t0) / (n1 - n0)
        return (origin + t0 - period * (n0 + zero), period) if period > 0.0 else None

    def _min_lateness(self, begin: float, period: float) -> float:
        """Return the minimum delay of the recent arrivals, s."""
        since = self._points[-1][1] - RECENT_SPAN
        return min(t - begin - period * n for n, t in self._points if t > since)


def laser_scan(
    turn: Revolution, begin: float, period: float, limits: tuple[float, float]
) -> LaserScan:
    """Return a turn as a scan with evenly spaced beams, as logs need it.

    The scan has `slots` beams, with the best phase. Each beam takes the range of the measurement with
    the nearest angle, within half a step, those with an echo first. None is interpolated or used twice,
    and a beam without one has range 0 (invalid). So angles are wrong by up to half a step. Time offsets
    are those of a constant speed. The lidar turns clockwise: angles decrease.

    Parameters
    ----------
    begin : host time of the turn's first measurement, s
    period : s per measurement
    limits : range_min and range_max, m
    """
    n = turn.slots
    step = 2.0 * math.pi / n
    angles = np.unwrap(turn.angles)
    angles -= 2.0 * math.pi if angles[0] > math.pi else 0.0
    phase = float(np.median(angles - step * turn.numbers))
    places = (angles - phase) / step
    cells = np.round(places)
    # Later ones overwrite earlier ones: those with an echo, and nearest to their cell, come last.
    order = np.lexsort((-np.abs(places - cells), turn.ranges > 0.0))
    # Near targets are shifted by some degrees; across the seam they would get a wrong time.
    order = order[(cells[order] >= 0) & (cells[order] < n)]
    chosen = cells[order].astype(np.int64)
    ranges, qualities = np.zeros(n), None
    ranges[chosen] = turn.ranges[order]
    if turn.qualities is not None:
        qualities = np.zeros(n)
        qualities[chosen] = turn.qualities[order]
    even = np.arange(n, dtype=np.float64)
    return LaserScan(begin, -(phase + step * even), ranges, period * even, *limits, qualities)
