"""Estimate offset and drift of a device's clock against the host's from the arrivals of readings.

A reading with device stamp d arrives on the host at

    h = offset + (1 + drift) d + delay,    delay >= 0,

where the delay has a long tail: bytes wait for polls of the bus and for the scheduler. A mean or a
least-squares line would follow that tail; the lower edge is unbiased. So the line is the closest one
below all arrivals of a window: the linear programme of Moon, Skelly and Towsley (INFOCOM 1999), whose
solution is the edge of the lower convex hull at the arrivals' mean (Zhang, Liu and Xia, INFOCOM 2002).
The minimum delay cannot be observed from one side; stamps are late by it.
"""

from __future__ import annotations

import math
from collections import deque

from impslam.platform.devices.lower_hull import Point, edge_at_mean

WINDOW = 30.0
"""s of arrivals that are used; a crystal's drift changes by less than 0.1 ppm/s as it warms, which bends
the line by 0.1e-6 WINDOW^2 / 8 = 11 us."""
MAX_DRIFT = 200e-6
"""Bound of the drift, above that of two crystals (100 ppm each)."""
BIN = 0.5  # s; only the earliest arrival of each bin is kept, as the edge lies on the early ones
STALL_DELAY = 0.1  # s of delay above which the host (or the bus) counts as stalled
MAX_STALL = 5.0  # s of stalled arrivals only, after which a clock has jumped instead
JUMP = 0.05  # s; an arrival this long before the earliest possible time: a clock has jumped
MIN_RATE = 0.5  # s/s, smallest rate of stamps while a line that was too late is corrected
MIN_STEP = 1e-6  # s, smallest step of stamps, even across a restart of the device


class DeviceClock:
    """Maps a device's clock (s, unwrapped) to the host's time base.

    Attributes
    ----------
    drift : 1, host seconds per device second, minus 1
    restarts : number of restarts of the device, or jumps of a clock
    stalls : number of times that arrivals were late by more than `STALL_DELAY`
    delay : s, delay of the last reading above the minimum delay
    """

    def __init__(self) -> None:
        self._bins: deque[Point] = deque(maxlen=round(WINDOW / BIN))
        self._origin: Point | None = None  # device and host time of the first arrival
        self._last_stamp: Point | None = None  # device and host time of the last returned stamp
        self._latest = -math.inf  # device time of the last arrival
        self._bin = 0
        self._line = (0.0, 0.0)  # (a, b): min(host - device) is a + b * device, from the origin
        self._late_since = math.inf
        self.restarts = self.stalls = 0
        self.delay = 0.0

    @property
    def drift(self) -> float:
        """Host seconds per device second, minus 1."""
        return self._line[1]

    @property
    def offset(self) -> float:
        """Host time minus device time at the last arrival, s; NaN before the first."""
        return self._predict_host(self._latest) - self._latest if self._origin else math.nan

    def restart(self) -> None:
        """Discard all arrivals; stamps keep increasing."""
        self._bins.clear()
        self._origin, self._latest, self._late_since = None, -math.inf, math.inf
        self._line = (0.0, self._line[1])
        if self._last_stamp is not None:
            self._last_stamp = (-math.inf, self._last_stamp[1])

    def observe(self, device: float, host: float) -> None:
        """Add the device's stamp of a reading and its arrival on the host."""
        if self._origin is not None and self._has_jumped(device, host):
            # An early arrival right after the start only means that the first ones were delayed.
            self.restarts += device < self._latest or device - self._origin[0] > MAX_STALL
            self.restart()
        if self._origin is None:
            self._origin, self._bin = (device, host), 0
        self._latest = device
        point = self._from_origin(device, host)
        height = point[1] - self._line_at(point[0])
        if self._add_to_bin(point) or height < 0.0:
            self._fit()
        self._note_stall(device, max(height, 0.0))

    def to_host(self, device: float) -> float:
        """Return the host time of a device time.

        For increasing device times, the results strictly increase, even if the line changes.
        """
        stamp = self._predict_host(device)
        if self._last_stamp is None:
            self._last_stamp = (device, stamp)
            return stamp
        before, last_stamp = self._last_stamp
        if device < before:
            return min(stamp, last_stamp - MIN_RATE * (before - device))
        if math.isinf(before):
            stamp = max(stamp, last_stamp + MIN_STEP)
        elif device > before:
            stamp = max(stamp, last_stamp + max(MIN_RATE * (device - before), MIN_STEP))
        else:
            return last_stamp
        self._last_stamp = (device, stamp)
        return stamp

    def _has_jumped(self, device: float, host: float) -> bool:
        x, y = self._from_origin(device, host)
        # A line of few bins may be wrong by as much as the maximum drift.
        early = self._line_at(x) - y > JUMP + MAX_DRIFT * abs(device - self._latest)
        return device < self._latest or early or device - self._late_since > MAX_STALL

    def _note_stall(self, device: float, height: float) -> None:
        """Record whether arrivals are delayed, and since when without interruption."""
        late = height > STALL_DELAY
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

    def _line_at(self, x: float) -> float:
        return self._line[0] + self._line[1] * x

    def _predict_host(self, device: float) -> float:
        if self._origin is None:
            raise RuntimeError("a device's clock is unknown before something arrived from it")
        x = device - self._origin[0]
        return self._origin[1] + x + self._line_at(x)

    def _add_to_bin(self, point: Point) -> bool:
        """Keep a point if it is the earliest of its bin; return whether it begins a new bin."""
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
        """Fit the line below all points that is highest at their mean, with a slope up to +-`MAX_DRIFT`."""
        slope = max(-MAX_DRIFT, min(MAX_DRIFT, self._slope()))
        self._line = min(y - slope * x for x, y in self._bins), slope

    def _slope(self) -> float:
        """Return the slope of the lower hull's edge at the mean, or the last slope if there is no edge."""
        edge = edge_at_mean(self._bins)
        if edge is None:
            return self.drift
        (x0, y0), (x1, y1) = edge
        return (y1 - y0) / (x1 - x0)


class Unwrapper:
    """Converts a device's wrapping counter to continuous s.

    Parameters
    ----------
    bits : width of the counter
    unit : s per count
    """

    def __init__(self, bits: int, unit: float) -> None:
        self._span, self._unit = 1 << bits, unit
        self._last, self._turns = 0, 0

    def __call__(self, raw: int) -> float:
        """Return the counter in s; a smaller value than before means that it has wrapped once."""
        if raw < self._last:
            self._turns += 1
        self._last = raw
        return (self._turns * self._span + raw) * self._unit

    def restart(self) -> None:
        """Begin at 0 again, as the device does."""
        self._last = self._turns = 0
