"""A common time line for streams whose clocks are set during a log.

If a clock is set in the middle of a log, by the network or by hand, the stamps of some or all streams
step back or ahead, while the order of the log remains correct. Each stream has a shift that is added to
its stamps. Where the clock of a stream was set, the shift changes so that time advances by one period
there, and streams that were synchronous remain so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

JITTER = 1.0
"""s: stamps that a busy computer assigns on arrival can run back by up to 0.9 s (the Intel log of the
SLAM benchmarks) although its clock was not set."""
LEAP = 2.0 * JITTER
"""s: jitter moves stamps ahead by less than this, from a late one to an early one."""

# Columns of a stream's newest row: its shift, stamp, time, lag behind the newest time of all streams,
# period, and how far other streams have leapt ahead since; all in s.
_SHIFT, _STAMP, _TIME, _LAG, _PERIOD, _LEAPED = range(6)
# Shared by all streams: the first and the newest time; the stream of the newest leap ahead (a pause or a
# step), its stamp, and the time before it.
_FIRST, _NOW, _LEAPER, _LEAP_STAMP, _LEAP_BEFORE = range(5)


class Step(NamedTuple):
    """A clock that was set: ahead by `by` s (back if negative) at a stamp of a stream.

    `row` is the row at which it was detected.
    """

    row: int
    stream: int
    by: float
    stamp: float

    def __str__(self) -> str:
        how = f"ahead by {self.by:.6g} s" if self.by > 0.0 else f"back by {-self.by:.6g} s"
        return f"stepped {how} at {self.stamp:.3f} s"


class Clocks:
    """Computes the shifts that bring the stamps of all streams onto a common time line."""

    def __init__(self) -> None:
        self._streams = np.zeros((0, 6))
        self._all = np.array([np.inf, -np.inf, 0.0, 0.0, 0.0])

    @property
    def elapsed(self) -> float:
        """Time since the first row, s on the common time line."""
        return float(self._all[_NOW] - self._all[_FIRST]) if len(self._streams) else 0.0

    def shifts(self, streams: Ints, stamps: Array) -> tuple[Array, list[Step]]:
        """Return the shifts (m,) s of rows in the order of the log, and the detected steps.

        `stamps` (m,) are in s; `streams` (m,) numbers the streams from 0 in order of appearance.
        """
        m, known = len(stamps), len(self._streams)
        new = max(int(streams.max(initial=-1)) + 1 - known, 0)
        self._streams = np.vstack((self._streams, np.zeros((new, 6))))
        shifts, steps = np.empty(m), np.empty((m, 4))
        count = _shift(self._streams, known, self._all, streams, stamps, shifts, steps)
        return shifts, [Step(int(k), int(s), float(by), float(t)) for k, s, by, t in steps[:count]]


@kernel
def _shift(
    table: Array,
    known: int,
    shared: Array,
    streams: Ints,
    stamps: Array,
    shifts: Array,
    steps: Array,
) -> int:
    """Write the shift of each row, and the steps; return the number of steps."""
    count = 0
    for k in range(len(stamps)):
        stream_index, stamp = streams[k], stamps[k]
        if stream_index >= known:
            now = shared[_NOW] if known else stamp
            shift = _nearest(table[:known], stamp, now, -np.inf, np.inf)
            table[stream_index, _SHIFT], table[stream_index, _STAMP] = shift, stamp
            table[stream_index, _TIME] = stamp + shift
            known = stream_index + 1
        else:
            steps[count, 0] = k
            count += _follow(table[:known], shared, stream_index, stamp, steps[count, 1:])
        _advance(table[:known], shared, stream_index, stamp)
        shifts[k] = table[stream_index, _SHIFT]
    return count


@kernel
def _nearest(table: Array, stamp: float, goal: float, low: float, high: float) -> float:
    """Return the shift in use that brings a stamp nearest to a goal; NaN if none is within the bounds.

    0 is always a candidate, because a clock that was set wrongly may be corrected again.
    """
    best, smallest = np.nan, np.inf
    for i in range(-1, len(table)):
        shift = 0.0 if i < 0 else table[i, _SHIFT]
        if low <= stamp + shift <= high and abs(stamp + shift - goal) < smallest:
            best, smallest = shift, abs(stamp + shift - goal)
    return best


@kernel
def _expected(stream: Array, now: float) -> float:
    """Return the expected time of the stream's next row; later if other streams have advanced."""
    due: float = stream[_TIME] + stream[_PERIOD]
    overdue: float = now - stream[_LAG]
    return overdue if overdue > due + JITTER else due


@kernel
def _follow(table: Array, shared: Array, stream_index: int, stamp: float, entry: Array) -> int:
    """Update the stream's shift if its clock or the others' was set; return 1 if a step is detected."""
    stream = table[stream_index]
    step, leaped, before = stamp - stream[_STAMP], stream[_LEAPED], stream[_SHIFT]
    expected = _expected(stream, shared[_NOW])
    low, high = expected - JITTER, max(expected, shared[_NOW]) + JITTER
    if step >= 0.5 * leaped:  # the stream leapt, too: all streams paused
        stream[_LEAPED] = 0.0
    if abs(step) > JITTER and not low <= stamp + before <= high:
        fitting = _nearest(table, stamp, expected, low, high)
        if not np.isnan(fitting):
            stream[_SHIFT] = fitting
        elif step < 0.0:
            stream[_SHIFT] = expected - stamp
        if stream[_SHIFT] > before:
            entry[0], entry[1], entry[2] = stream_index, step - stream[_PERIOD], stamp
            return 1
    elif leaped != 0.0 and step < 0.5 * leaped and shared[_LEAP_BEFORE] < stamp + before:
        stream[_SHIFT] += leaped
        stream[_LEAPED] = 0.0
        entry[0], entry[1], entry[2] = shared[_LEAPER], leaped, shared[_LEAP_STAMP]
        return 1
    elif step > 0.0:
        stream[_PERIOD] += (0.1 if stream[_PERIOD] else 1.0) * (step - stream[_PERIOD])
    return 0


@kernel
def _advance(table: Array, shared: Array, stream_index: int, stamp: float) -> None:
    """Advance the time to a stamp of a stream."""
    stream = table[stream_index]
    time = stamp + stream[_SHIFT]
    if time > max(shared[_NOW], stream[_TIME] + stream[_PERIOD]) + LEAP:
        shared[_LEAPER], shared[_LEAP_STAMP], shared[_LEAP_BEFORE] = (
            stream_index,
            stamp,
            shared[_NOW],
        )
        leap = time - _expected(stream, shared[_NOW])
        for i in range(len(table)):
            if i != stream_index:
                table[i, _LEAPED] += leap
    shared[_FIRST], shared[_NOW] = min(shared[_FIRST], time), max(shared[_NOW], time)
    stream[_STAMP], stream[_TIME] = stamp, max(stream[_TIME], time)
    stream[_LAG] = shared[_NOW] - time
