"""One time line for streams whose clocks are set while they run.

A computer's clock is set in the middle of a log, by the network or by hand: stamps step back or ahead, of
every stream or of some. What happened still happened in the order of the log. Each stream gets a shift
that is added to its stamps; it changes where the stream's clock was set, so that time goes on by one
period there, and streams that were in step stay in step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

JITTER = 1.0
"""s: stamps that a busy computer gives on arrival run back by up to 0.9 s (the Intel log of the SLAM
benchmarks) and the clock is still the same."""
LEAP = 2.0 * JITTER
"""s: jitter takes stamps ahead by less, from one that is late to one that is early."""

# Columns of a stream's newest row: its shift, its stamp, when that was, how far behind the newest of
# all, its period, and how far other streams have leapt ahead since; all in s.
_SHIFT, _STAMP, _TIME, _LAG, _PERIOD, _LEAPT = range(6)
# Of all streams: the first and the newest time; whose the newest leap ahead was, a pause or a step, at
# which stamp, and what time it was before.
_FIRST, _NOW, _LEAPER, _LEAP_STAMP, _LEAP_BEFORE = range(5)


class Step(NamedTuple):
    """A clock that was set: ahead by `by` s (back if negative) at a stamp of a stream.

    `row` is the row that told it.
    """

    row: int
    stream: int
    by: float
    stamp: float

    def __str__(self) -> str:
        how = f"ahead by {self.by:.6g} s" if self.by > 0.0 else f"back by {-self.by:.6g} s"
        return f"stepped {how} at {self.stamp:.3f} s"


class Clocks:
    """Tells what to add to the stamps of each stream to have them on one time line."""

    def __init__(self) -> None:
        self._streams = np.zeros((0, 6))
        self._all = np.array([np.inf, -np.inf, 0.0, 0.0, 0.0])

    @property
    def elapsed(self) -> float:
        """How long it has been since the first row, s on the one time line."""
        return float(self._all[_NOW] - self._all[_FIRST]) if len(self._streams) else 0.0

    def shifts(self, streams: Ints, stamps: Array) -> tuple[Array, list[Step]]:
        """Return what to add to the stamps (m,) of rows, in the log's order, and the steps.

        `streams` (m,) counts streams from 0 in the order in which they first come.
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
    """Write the shift of each row, and the steps; return how many there are."""
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
    """Return the shift that brings a stamp nearest to a goal, of those in use; nan if none is within.

    A clock that was set back may be set right again: 0 is always one of them.
    """
    best, least = np.nan, np.inf
    for i in range(-1, len(table)):
        shift = 0.0 if i < 0 else table[i, _SHIFT]
        if low <= stamp + shift <= high and abs(stamp + shift - goal) < least:
            best, least = shift, abs(stamp + shift - goal)
    return best


@kernel
def _expected(stream: Array, now: float) -> float:
    """Return when the stream's next row is due, or overdue if others went on without it."""
    due: float = stream[_TIME] + stream[_PERIOD]
    overdue: float = now - stream[_LAG]
    return overdue if overdue > due + JITTER else due


@kernel
def _follow(table: Array, every: Array, name: int, stamp: float, entry: Array) -> int:
    """Change the stream's shift if its clock, or that of the others, was set since; 1 if told."""
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
    """Let time go on to a stamp of a stream."""
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
