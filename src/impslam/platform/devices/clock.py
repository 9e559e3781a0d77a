"""A device's clock against the host's: offset and drift from the moments at which readings arrive.

What a device stamps with d arrives on the host at

    h = offset + (1 + drift) d + delay,    delay >= 0,

where the delay has a long tail: bytes wait for the bus to be polled, and for the scheduler. A mean
or a least-squares line would follow that tail; what is true is the lower edge. So the line is the
one below all arrivals of a window that lies as near to them as it can: the linear programme of
Moon, Skelly and Towsley (INFOCOM 1999), whose solution is the edge of the lower convex hull over
the arrivals' mean (Zhang, Liu and Xia, INFOCOM 2002). The least delay itself cannot be seen from
one side: stamps are late by it.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import TypeAlias

Point: TypeAlias = tuple[float, float]

BIN = 0.5  # s; only the earliest arrival of each bin is kept, for none of the others is on the edge
STALL = 0.1  # s of delay from which on the host (or the bus) is said to have stalled
SETTLED = 5.0  # s of nothing but stalled arrivals: it is no stall, a clock has jumped
JUMP = 0.05  # s; an arrival this far before its earliest possible moment: a clock has jumped
SLOWEST = 0.5  # s/s, how slowly stamps may advance while a too late line is being put right
TICK = 1e-6  # s that stamps advance at least, also over a restart of the device


class DeviceClock:
    """Maps a device's clock (s, unwrapped) to the host's time base.

    Parameters
    ----------
    window : s of arrivals that count; a crystal's drift changes by less than 0.1 ppm/s as it warms,
        which bends the line by 0.1e-6 window^2 / 8 = 11 us over 30 s
    max_drift : no crystal is further off than this (100 ppm), and no resonator should be

    Attributes
    ----------
    drift : 1, host seconds per device second, less 1
    restarts : how often the device began anew or one of the clocks jumped
    stalls : how often arrivals were held up by more than `STALL`
    delay : s, how late the last reading arrived, over the least delay
    """

    def __init__(self, window: float = 30.0, max_drift: float = 200e-6) -> None:
        self._max_drift = max_drift
        self._bins: deque[Point] = deque(maxlen=max(2, round(window / BIN)))
        self._origin: Point | None = None  # device and host time of the first arrival
        self._last_stamp: Point | None = None  # device and host time of the last stamp given out
        self._latest = -math.inf  # device time of the last arrival
        self._bin = 0
        self._line = (0.0, 0.0)  # (a, b): the least (host - device) is a + b * device, from origin
        self._late_since = math.inf
        self.restarts = self.stalls = 0
        self.delay = 0.0

    @property
    def drift(self) -> float:
        """Host seconds per device second, less 1."""
        return self._line[1]

    @property
    def offset(self) -> float:
        """Host time less device time at the last arrival, in s; NaN before the first."""
        return self._on_line(self._latest) - self._latest if self._origin else math.nan

    @property
    def sigma(self) -> float:
        """How sure a stamp is, in s: the median height of each bin's first arrival over the line."""
        if len(self._bins) < 2:
            return math.inf
        heights = sorted(y - self._below(x) for x, y in self._bins)
        return heights[len(heights) // 2]

    def restart(self) -> None:
        """Forget all arrivals; stamps go on increasing."""
        self._bins.clear()
        self._origin, self._latest, self._late_since = None, -math.inf, math.inf
        self._line = (0.0, self._line[1])
        if self._last_stamp is not None:
            self._last_stamp = (-math.inf, self._last_stamp[1])

    def observe(self, device: float, host: float) -> None:
        """Take the device's clock in a reading and the host's at the reading's arrival."""
        if self._origin is not None and self._has_jumped(device, host):
            # Early right after the start means only that the very first arrivals were held up.
            self.restarts += device < self._latest or device - self._origin[0] > SETTLED
            self.restart()
        if self._origin is None:
            self._origin, self._bin = (device, host), 0
        self._latest = device
        point = self._from_origin(device, host)
        height = point[1] - self._below(point[0])
        if self._into_bin(point) or height < 0.0:
            self._fit()
        self._judge(device, max(height, 0.0))

    def to_host(self, device: float) -> float:
        """Return the host's time for a moment of the device's clock.

        For moments that increase, so do the results, strictly, whatever the line does meanwhile.
        """
        stamp = self._on_line(device)
        if self._last_stamp is None:
            self._last_stamp = (device, stamp)
            return stamp
        before, given = self._last_stamp
        if device < before:
            return min(stamp, given - SLOWEST * (before - device))
        if math.isinf(before):
            stamp = max(stamp, given + TICK)
        elif device > before:
            stamp = max(stamp, given + max(SLOWEST * (device - before), TICK))
        else:
            return given
        self._last_stamp = (device, stamp)
        return stamp

    def _has_jumped(self, device: float, host: float) -> bool:
        x, y = self._from_origin(device, host)
        # A line of few bins may be wrong by as much as the drift is.
        early = self._below(x) - y > JUMP + self._max_drift * abs(device - self._latest)
        return device < self._latest or early or device - self._late_since > SETTLED

    def _judge(self, device: float, height: float) -> None:
        """Note whether arrivals are being held up, and since when without a break."""
        late = height > STALL
        self.delay = height
        if not late:
            self._late_since = math.inf
        elif math.isinf(self._late_since):
            self._late_since = device
            self.stalls += 1

    def _from_origin(self, device: float, host: float) -> Point:
        assert self._origin is not None
        x = device - self._origin[0]
        return x, host - self._origin[1] - x

    def _below(self, x: float) -> float:
        return self._line[0] + self._line[1] * x

    def _on_line(self, device: float) -> float:
        if self._origin is None:
            raise RuntimeError("a device's clock is not known before something arrived from it")
        x = device - self._origin[0]
        return self._origin[1] + x + self._below(x)

    def _into_bin(self, point: Point) -> bool:
        """Keep a point if it is the earliest of its bin; return whether a bin has been completed."""
        x, y = point
        number = int(x / BIN)
        if not self._bins or number != self._bin:
            self._bin = number
            self._bins.append(point)
            return True
        x_kept, y_kept = self._bins[-1]
        if y - self.drift * x < y_kept - self.drift * x_kept:
            self._bins[-1] = point
        return False

    def _fit(self) -> None:
        """Put the line below all points, as high as it goes at their mean, within `max_drift`."""
        middle = sum(x for x, _ in self._bins) / len(self._bins)
        slope = max(-self._max_drift, min(self._max_drift, self._slope_at(middle)))
        self._line = min(y - slope * x for x, y in self._bins), slope

    def _slope_at(self, middle: float) -> float:
        """Return the slope of the lower hull's edge over a point; the last slope where none is."""
        hull = lower_hull(self._bins)
        for (x0, y0), (x1, y1) in pairwise(hull):
            if x1 >= middle and x1 > x0:
                return (y1 - y0) / (x1 - x0)
        return self.drift


def lower_hull(points: deque[Point]) -> list[Point]:
    """Return the lower convex hull of points in order of x (Andrew's monotone chain)."""
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], (x, y)):
            hull.pop()
        hull.append((x, y))
    return hull


def _turns_down(a: Point, b: Point, c: Point) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])


class Unwrapper:
    """Turns a device's counter, which wraps, into s that go on.

    Parameters
    ----------
    bits : width of the counter
    unit : s per count
    """

    def __init__(self, bits: int, unit: float) -> None:
        self._span, self._unit = 1 << bits, unit
        self._last, self._turns = 0, 0

    def __call__(self, raw: int) -> float:
        """Return the counter in s; less than before means that it has wrapped once."""
        if raw < self._last:
            self._turns += 1
        self._last = raw
        return (self._turns * self._span + raw) * self._unit

    def restart(self) -> None:
        """Begin anew, as the device has."""
        self._last = self._turns = 0
