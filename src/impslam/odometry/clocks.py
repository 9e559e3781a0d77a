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

# Columns of a stream's newest row: its shift, its stamp, when that was, how far behind the newest of
# all, its period, and how far other streams have leapt ahead since; all in s.
_SHIFT, _STAMP, _TIME, _LAG, _PERIOD, _LEAPT = range(6)
# Of all streams: the first and the newest time; whose the newest leap ahead was, a pause or a step, at
# which stamp, and what time it was before.
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
    every: Array,
    streams: Ints,
    stamps: Array,
    shifts: Array,
    steps: Array,
) -> int:
    """Write the shift of each row, and the steps; return the number of steps."""
    count = 0
    for k in range(len(stamps)):
        name, stamp = streams[k], stamps[k]
        if name >= known:
            now = every[_NOW] if known else stamp
            shift = _nearest(table[:known], stamp, now, -np.inf, np.inf)
            table[name, _SHIFT], table[name, _STAMP] = shift, stamp
            table[name, _TIME] = stamp + shift
            known = name + 1
        else:
            steps[count, 0] = k
            count += _follow(table[:known], every, name, stamp, steps[count, 1:])
        _advance(table[:known], every, name, stamp)
        shifts[k] = table[name, _SHIFT]
    return count


@kernel
def _nearest(table: Array, stamp: float, goal: float, low: float, high: float) -> float:
    """Return the shift in use that brings a stamp nearest to a goal; NaN if none is within the bounds.

    0 is always a candidate, because a clock that was set wrongly may be corrected again.
    """
    best, least = np.nan, np.inf
    for i in range(-1, len(table)):
        shift = 0.0 if i < 0 else table[i, _SHIFT]
        if low <= stamp + shift <= high and abs(stamp + shift - goal) < least:
            best, least = shift, abs(stamp + shift - goal)
    return best


@kernel
def _expected(stream: Array, now: float) -> float:
    """Return the expected time of the stream's next row; later if other streams have advanced."""
    due: float = stream[_TIME] + stream[_PERIOD]
    overdue: float = now - stream[_LAG]
    return overdue if overdue > due + JITTER else due


@kernel
def _follow(table: Array, every: Array, name: int, stamp: float, entry: Array) -> int:
    """Update the stream's shift if its clock or the others' was set; return 1 if a step is detected."""
    stream = table[name]
    step, leapt, before = stamp - stream[_STAMP], stream[_LEAPT], stream[_SHIFT]
    expected = _expected(stream, every[_NOW])
    low, high = expected - JITTER, max(expected, every[_NOW]) + JITTER
    if step >= 0.5 * leapt:  # it went along: a pause of all
        stream[_LEAPT] = 0.0
    if abs(step) > JITTER and not low <= stamp + before <= high:
        fitting = _nearest(table, stamp, expected, low, high)
        if not np.isnan(fitting):
            stream[_SHIFT] = fitting
        elif step < 0.0:
            stream[_SHIFT] = expected - stamp
        if stream[_SHIFT] > before:
            entry[0], entry[1], entry[2] = name, step - stream[_PERIOD], stamp
            return 1
    elif leapt != 0.0 and step < 0.5 * leapt and every[_LEAP_BEFORE] < stamp + before:
        stream[_SHIFT] += leapt
        stream[_LEAPT] = 0.0
        entry[0], entry[1], entry[2] = every[_LEAPER], leapt, every[_LEAP_STAMP]
        return 1
    elif step > 0.0:
        stream[_PERIOD] += (0.1 if stream[_PERIOD] else 1.0) * (step - stream[_PERIOD])
    return 0


@kernel
def _advance(table: Array, every: Array, name: int, stamp: float) -> None:
    """Advance the time to a stamp of a stream."""
    stream = table[name]
    time = stamp + stream[_SHIFT]
    if time > max(every[_NOW], stream[_TIME] + stream[_PERIOD]) + LEAP:
        every[_LEAPER], every[_LEAP_STAMP], every[_LEAP_BEFORE] = name, stamp, every[_NOW]
        leap = time - _expected(stream, every[_NOW])
        for i in range(len(table)):
            if i != name:
                table[i, _LEAPT] += leap
    every[_FIRST], every[_NOW] = min(every[_FIRST], time), max(every[_NOW], time)
    stream[_STAMP], stream[_TIME] = stamp, max(stream[_TIME], time)
    stream[_LAG] = every[_NOW] - time
