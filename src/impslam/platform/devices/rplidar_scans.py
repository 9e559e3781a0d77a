"""Turns of an RPLidar made into scans: cut at the start bit, timed, laid on an even grid."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from impslam.platform.devices.rplidar_protocol import Nodes
from impslam.types import Array, LaserScan

WINDOW = 6.0  # s over which the sampling rate is fitted: a part of them is on time on any machine
SPACING = 0.02  # s between the points of the fit
RECENT = 1.0  # s
UNEVEN = 0.6  # rad that a turn may differ from a full one: near targets shift angles by 8 deg
LATE = 0.03  # s by which all recent arrivals must be late to show that bytes were lost unseen


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The measurements of one turn: `slots` were due, `numbers` (n,) of them came.

    `numbers` count from `first`, that of the turn's first one in the stream; angles (n,) rad
    clockwise, ranges (n,) m, qualities (n,) or None.
    """

    first: int
    slots: int
    numbers: Array
    angles: Array
    ranges: Array
    qualities: Array | None


class Turns:
    """Cuts nodes into whole turns. `broken` counts those that are not one turn long."""

    def __init__(self) -> None:
        self._parts: list[Nodes] = []
        self.broken = 0

    def add(self, nodes: Nodes) -> list[Turn]:
        """Take nodes and return the turns that they end."""
        cuts = np.flatnonzero(nodes.starts).tolist()
        turns = []
        begin = 0
        for cut in cuts:
            self._parts.append(_cut(nodes, begin, cut))
            turn = self._close(nodes.first + cut)
            turns += [turn] if turn is not None else []
            begin = cut
        self._parts.append(_cut(nodes, begin, len(nodes.starts)))
        if not cuts and (self._parts[-1].first - self._parts[0].first) > 2**16:
            self._parts.clear()  # turns no more, or its start bit is dead
            self.broken += 1
        return turns

    def _close(self, end: int) -> Turn | None:
        """Return the turn that ends before a number; None if it did not begin with a start."""
        parts, self._parts = [part for part in self._parts if len(part.starts)], []
        if not parts or not parts[0].starts[0]:
            return None
        first = parts[0].first
        angles = np.concatenate([part.angles for part in parts])
        turned = np.unwrap(angles)[-1] - angles[0] if len(angles) else 0.0
        if abs(turned - 2.0 * math.pi) > UNEVEN or first >= end:
            self.broken += 1
            return None
        numbers = [part.first - first + np.arange(len(part.starts)) for part in parts]
        qualities = [part.qualities for part in parts if part.qualities is not None]
        return Turn(
            first,
            end - first,
            np.concatenate(numbers).astype(np.float64),
            angles,
            np.concatenate([part.ranges for part in parts]),
            np.concatenate(qualities) if qualities else None,
        )


def _cut(nodes: Nodes, begin: int, end: int) -> Nodes:
    qualities = nodes.qualities
    return Nodes(
        nodes.first + begin,
        nodes.starts[begin:end],
        nodes.angles[begin:end],
        nodes.ranges[begin:end],
        None if qualities is None else qualities[begin:end],
    )


class NodeClock:
    """When measurements were made, told by their numbers and by when their bytes arrived.

    The lidar has no clock, but it measures at an even rate. Bytes come late by varying amounts and
    never early: of all lines (time over number) that no arrival lies below, the one with the least
    lateness on average is taken. It is the edge of the arrivals' lower convex hull beneath their
    mean (Zhang, Liu & Xia 2002), and the truth but for the shortest delay.
    """

    def __init__(self) -> None:
        self._points: deque[tuple[int, float]] = deque()

    def observe(self, number: int, arrived: float) -> None:
        """Take that all measurements before this number had come by then (host, s)."""
        points = self._points
        last, when = points[-1] if points else (0, -math.inf)
        if number <= last or arrived - when < SPACING:
            return  # nothing new: it has not begun, or sends in bursts
        points.append((number, arrived))
        while arrived - points[0][1] > WINDOW:
            points.popleft()

    def fit(self) -> tuple[float, float] | None:
        """Return (s at number 0, s per measurement); None before half a second has been seen."""
        line = self._line()
        if line is not None and self._late(*line) > LATE:
            points = self._points  # bytes were lost unseen: what was before no longer fits
            while points[-1][1] - points[0][1] > RECENT:
                points.popleft()
            line = self._line()
        return line

    def _line(self) -> tuple[float, float] | None:
        points = self._points
        if len(points) < 4 or points[-1][1] - points[0][1] < 0.5 * RECENT:
            return None
        zero, origin = points[-1]  # counted from here, lest digits are lost
        (n0, t0), (n1, t1) = _lower_edge([(n - zero, t - origin) for n, t in points])
        period = (t1 - t0) / (n1 - n0)
        return (origin + t0 - period * (n0 + zero), period) if period > 0.0 else None

    def _late(self, begin: float, period: float) -> float:
        """Return by how much all of the recent arrivals are late, in s."""
        since = self._points[-1][1] - RECENT
        return min(t - begin - period * n for n, t in self._points if t > since)


def _lower_edge(points: list[tuple[int, float]]) -> tuple[tuple[int, float], tuple[int, float]]:
    """Return the edge of the lower convex hull that spans the mean abscissa of points in order."""
    hull: list[tuple[int, float]] = []
    for point in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    mean = sum(n for n, _ in points) / len(points)
    return next((a, b) for a, b in pairwise(hull) if b[0] >= mean)


def _turns_right(a: tuple[int, float], b: tuple[int, float], c: tuple[int, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])


def laser_scan(turn: Turn, begin: float, period: float, limits: tuple[float, float]) -> LaserScan:
    """Return a turn as a scan whose beams are evenly spaced, as logs need it.

    The grid has as many beams as the turn had measurements, and the phase that suits them best. Each
    of its beams takes the range of the measurement whose angle is nearest and within half a step,
    those with an echo first; none is interpolated, none is used twice, and a beam that gets none
    reads 0 (invalid). Its angle is wrong by up to half a step therefore. Time offsets are those of
    an even turn. The lidar turns clockwise: angles decrease.

    Parameters
    ----------
    begin : s, host time of the turn's first measurement
    period : s per measurement
    limits : m, range_min and range_max
    """
    n = turn.slots
    step = 2.0 * math.pi / n
    angles = np.unwrap(turn.angles)
    angles -= 2.0 * math.pi if angles[0] > math.pi else 0.0
    phase = float(np.median(angles - step * turn.numbers))
    places = (angles - phase) / step
    cells = np.round(places)
    # Last come those that win: with an echo, and near their place.
    order = np.lexsort((-np.abs(places - cells), turn.ranges > 0.0))
    # Near targets are shifted by some degrees; across the seam they would get the wrong time.
    order = order[(cells[order] >= 0) & (cells[order] < n)]
    chosen = cells[order].astype(np.int64)
    ranges, qualities = np.zeros(n), None
    ranges[chosen] = turn.ranges[order]
    if turn.qualities is not None:
        qualities = np.zeros(n)
        qualities[chosen] = turn.qualities[order]
    even = np.arange(n, dtype=np.float64)
    return LaserScan(begin, -(phase + step * even), ranges, period * even, *limits, qualities)
