"""A common time line for streams whose clocks are set during a log, or whose stamps are not times.

If a clock is set in the middle of a log, by the network or by hand, the stamps of some or all streams
step back or ahead, while the order of the log remains correct. Each stream has a shift that is added to
its stamps. Where the clock of a stream was set, the shift changes so that time advances by one period
there, and streams that were synchronous remain so.

Other stamps are not times at all: zero, random, or so coarse that they are equal for seconds. The order of
the log then decides: such a row is placed at the newest time of all streams. A clock runs at 1 s/s and is
rarely set, so a stamp contradicts the order if

- it repeats while the time of other streams advances, or ten times;
- it does not advance, and is more than the jitter before the newest time;
- it jumps, although the clock of the stream was set twice before, and the next stamp does not continue it.

A stream whose stamps mostly contradict the order is used by order alone, until its stamps run again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

JITTER = 1.0
"""s: stamps that a busy computer assigns on arrival can run back by up to 0.9 s (the Intel log of the
SLAM benchmarks) although its clock was not set."""
JUMP = 2.0 * JITTER
"""s: jitter moves stamps ahead by less than this, from a late one to an early one."""
MAX_PAUSE = 86400.0
"""s: a clock that jumps further ahead was set; a pause of a log is shorter."""
LATEST = 1e11
"""s: a stamp beyond this, in the year 5138, is invalid."""
RESOLUTION = 1e-6
"""s: stamps that are closer are equal; stamps of this century are exact to 2e-7 s."""
MAX_REPEATS, MAX_ADVANCE = 10, 0.02
"""Times that a stamp may repeat, and s by which other streams may advance if it repeats twice. A message
may be logged twice, and a busy computer stamps a few at once."""
MAX_PERIOD = 10.0
"""s between two rows of a stream whose stamps are believed again."""
MEMORY = 16.0
"""Rows over which the share of contradicting stamps is averaged."""
DISTRUST, TRUST = 0.6, 0.2
"""Shares of contradicting stamps above which a stream is used by order, and below which by stamp again.
Half of the rows of a CARMEN log contradict if one kind of line has no stamps."""
MAX_SET = 2
"""Times that a clock is set; after that, a jump is a wrong stamp unless the next stamp continues it."""
MIN_PACE = 0.5
"""Least advance of a stream whose clock was set, relative to that of the others in the same rows."""
MAX_AHEAD = 60.0
"""s by which a stream that is no longer believed may leave the time of the others behind."""
MAX_UNTIMED = 0.1
"""Share of rows without any usable clock above which the duration of a log is unknown."""

BY_STAMP, CLOCK_SET, WITH_ODOMETRY, BY_ORDER = range(4)
"""How a row is used: by its stamp; by its stamp, where its clock was set; by order, because of other rows;
by order, because of its own stamp."""
_LATE = 4  # by order, because it is the first row of its stream, and from before the log

# Columns of a stream; the first six, in s, are of its newest row that is used by stamp.
_SHIFT = 0  # of its clock
_STAMP, _TIME = 1, 2  # as received, and on the common time line
_LAG = 3  # behind the newest time of all streams
_PERIOD = 4
_JUMPED = 5  # how far other streams have jumped ahead since
_NEWEST = 6  # stamp of the newest row, s, however used
_REPEATS = 7  # how often `_STAMP` was repeated
_SINCE = 8  # newest time of all streams when `_STAMP` was new, s
_ROWS = 9  # that were judged
_BAD, _SHARE = 10, 11  # number and mean share of the rows that contradict the order
_HOW = 12  # how the newest row is used
_DISTRUSTED = 13  # whether all rows are used by order
_AFTER = 14  # stamp of its first row after another stream jumped ahead, or NaN
_JUMPER = 15  # stamp of that stream then
_WIDTH = 16

# What all streams share; times in s.
_FIRST, _NOW = 0, 1  # the first and the newest time
_JUMP_STREAM, _JUMP_STAMP = 2, 3  # stream and stamp of the newest jump ahead, a pause or a step
_JUMP_BEFORE, _JUMP = 4, 5  # the time before it, and its size until it turns out to be a step
_EXCESS = 6  # the sum of such steps
_COUNT, _UNTIMED = 7, 8  # rows, and those without any usable clock
_STAMP_BEFORE, _TIME_BEFORE = 9, 10  # of the row before


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


class PlacedRows(NamedTuple):
    """Times of m rows.

    Attributes
    ----------
    shifts : (m,) s, to add to the stamps of rows that are used by stamp
    times : (m,) s, on the common time line
    how : (m,) BY_STAMP, CLOCK_SET, WITH_ODOMETRY or BY_ORDER
    """

    shifts: Array
    times: Array
    how: Ints

    def take(self, rows: slice | Ints) -> PlacedRows:
        """Return some of the rows."""
        return PlacedRows(self.shifts[rows], self.times[rows], self.how[rows])

    @property
    def by_order(self) -> Mask:
        """Rows (m,) that are used by order."""
        return np.asarray(self.how >= WITH_ODOMETRY)


class Clocks:
    """Brings the stamps of all streams onto a common time line."""

    def __init__(self) -> None:
        self._streams = np.zeros((0, _WIDTH))
        self._all = np.array([np.inf, -np.inf, *np.zeros(7), np.nan, np.nan])

    @property
    def elapsed(self) -> float:
        """Time since the first row, s on the common time line; NaN if few stamps are usable."""
        first, now, excess = self._all[[_FIRST, _NOW, _EXCESS]]
        if not self._all[_COUNT]:
            return 0.0
        if self._all[_UNTIMED] > MAX_UNTIMED * self._all[_COUNT]:
            return float("nan")
        return float(now - first - excess)

    def place(
        self, streams: Ints, stamps: Array, odometry: int = -1
    ) -> tuple[PlacedRows, list[Step]]:
        """Return the times of rows in the order of the log, and the detected steps.

        `stamps` (m,) are in s; `streams` (m,) numbers the streams from 0 in order of appearance. Where
        rows of stream `odometry` are used by order, so are those of the other streams.
        """
        m, known = len(stamps), len(self._streams)
        new = max(int(streams.max(initial=-1)) + 1 - known, 0)
        self._streams = np.vstack((self._streams, np.zeros((new, _WIDTH))))
        placed, steps = (
            PlacedRows(np.empty(m), np.empty(m), np.empty(m, np.int64)),
            np.empty((m, 4)),
        )
        state = self._streams, self._all
        count = _place(state, known, odometry, streams, stamps, placed, steps)
        return placed, [Step(int(k), int(s), float(by), float(t)) for k, s, by, t in steps[:count]]


@kernel
def _place(
    state: tuple[Array, Array],
    known: int,
    odometry: int,
    streams: Ints,
    stamps: Array,
    placed: PlacedRows,
    steps: Array,
) -> int:
    """Write the place of each row, and the steps; return the number of steps.

    `state` is the table (known or more, 16) of the streams, and what they share (11,); a row k of m is of
    stream `streams[k]` at `stamps[k]`. Rows of `steps` (m, 4) are those of `Step`.
    """
    table, shared = state
    count = 0
    for k in range(len(stamps)):
        stream_index, stamp = streams[k], stamps[k]
        stream = table[stream_index]
        if stream_index >= known:
            _begin(table[:known], shared, stream, stamp)
            known = stream_index + 1
        else:
            steps[count, 0] = k
            count += _follow(table[:known], shared, stream_index, stamp, steps[count, 1:])
        if stream[_HOW] == BY_ORDER:
            stream[_LAG], stream[_JUMPED] = 0.0, 0.0
            _rewind(table[:known], shared)
            stream[_TIME] = max(stream[_TIME], shared[_NOW])
        else:
            _advance(table[:known], shared, stream_index, stamp)
            if stream[_REPEATS] == 0.0:
                stream[_SINCE] = shared[_NOW]
        stream[_NEWEST] = stamp
        _write(table[:known], shared, stream_index, odometry, placed, k)
        shared[_COUNT] += 1.0
        shared[_UNTIMED] += table[:known, _DISTRUSTED].min()
    return count


@kernel
def _write(
    table: Array, shared: Array, stream_index: int, odometry: int, placed: PlacedRows, k: int
) -> None:
    """Write the place of row k, the newest one of its stream."""
    stream = table[stream_index]
    stamp, how = stream[_NEWEST], stream[_HOW]
    placed.shifts[k], placed.times[k] = stream[_SHIFT], stamp + stream[_SHIFT]
    placed.how[k] = WITH_ODOMETRY if how == _LATE else int(how)
    if how >= BY_ORDER:
        placed.times[k] = shared[_NOW] if shared[_NOW] > -np.inf else 0.0
    elif 0 <= odometry < len(table) and table[odometry, _HOW] == BY_ORDER:
        placed.how[k] = WITH_ODOMETRY
    elif stamp == shared[_STAMP_BEFORE] and placed.times[k] != shared[_TIME_BEFORE]:
        placed.how[k] = WITH_ODOMETRY  # recorded together, but placed at different times
    shared[_STAMP_BEFORE], shared[_TIME_BEFORE] = stamp, placed.times[k]


@kernel
def _rewind(table: Array, shared: Array) -> None:
    """Set the newest time to that of the usable streams, if a stream that is not was ahead."""
    newest = -np.inf
    for i in range(len(table)):
        if not table[i, _DISTRUSTED]:
            newest = max(newest, table[i, _STAMP] + table[i, _SHIFT])
    if -np.inf < newest < shared[_NOW] - MAX_AHEAD:
        shared[_EXCESS] = max(shared[_EXCESS] - (shared[_NOW] - newest), 0.0)
        shared[_NOW], shared[_FIRST] = newest, min(shared[_FIRST], newest)


@kernel
def _begin(table: Array, shared: Array, stream: Array, stamp: float) -> None:
    """Start a stream at its first row; `table` has the other streams."""
    stream[_ROWS], stream[_HOW] = 1.0, BY_STAMP
    if not abs(stamp) <= LATEST:  # or NaN
        stream[_BAD], stream[_SHARE] = MAX_SET, 1.0
        stream[_HOW], stream[_DISTRUSTED] = BY_ORDER, 1.0
        return
    now = shared[_NOW] if shared[_NOW] > -np.inf else stamp
    shift = _nearest(table, stamp, now, -np.inf, np.inf)
    stream[_SHIFT], stream[_STAMP], stream[_TIME] = shift, stamp, stamp + shift
    if shared[_FIRST] < np.inf and stamp + shift < shared[_FIRST] - JITTER:
        stream[_HOW] = _LATE
    elif stamp + shift > now + JUMP:  # another clock, or a pause: no evidence of time
        shared[_EXCESS] += stamp + shift - now


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
    """Judge a stamp, and update the shift of its stream; return 1 if a step is detected."""
    stream = table[stream_index]
    if stream[_DISTRUSTED]:
        _reconsider(table, shared, stream, stamp)
        return 0
    step = stamp - stream[_STAMP]
    expected = _expected(stream, shared[_NOW])
    low, high = expected - JITTER, max(expected, shared[_NOW]) + JITTER
    jumps = abs(step) > JITTER and not low <= stamp + stream[_SHIFT] <= high
    fitting = _nearest(table, stamp, expected, low, high) if jumps else stream[_SHIFT]
    was_by_order = stream[_HOW] == BY_ORDER
    stream[_REPEATS] += abs(step) <= RESOLUTION
    if _contradicts(shared, stream, stamp, fitting):
        _judge(stream, True)
        return 0
    stream[_HOW] = BY_STAMP
    if abs(step) > RESOLUTION:
        stream[_REPEATS] = 0.0
        if not jumps:
            _judge(stream, False)
    if stream[_JUMPED] != 0.0 and step >= 0.5 * stream[_JUMPED]:  # all streams paused
        stream[_JUMPED] = shared[_JUMP] = 0.0
    if jumps:
        return _set(table, shared, stream_index, stamp, (expected, fitting), entry)
    if stream[_JUMPED] != 0.0 and _shows_step(table, shared, stream, stamp):
        entry[0], entry[1], entry[2] = shared[_JUMP_STREAM], stream[_JUMPED], shared[_JUMP_STAMP]
        stream[_SHIFT] += stream[_JUMPED]
        stream[_JUMPED] = 0.0
        _refute(table, shared)
        return 1
    if step > 0.0 and not was_by_order:
        stream[_PERIOD] += (0.1 if stream[_PERIOD] else 1.0) * (step - stream[_PERIOD])
    return 0


@kernel
def _shows_step(table: Array, shared: Array, stream: Array, stamp: float) -> bool:
    """Return whether a stream that did not jump ahead shows that the one that did was set.

    It then continues beyond the time before the jump. A stream that was late before must also advance at
    the pace of the other: rows that a network held up come faster, until they are no longer late. The
    stamps of both at the first row after the jump are kept for that.
    """
    jumper, before = table[int(shared[_JUMP_STREAM]), _STAMP], shared[_JUMP_BEFORE]
    if np.isnan(stream[_AFTER]):
        stream[_AFTER], stream[_JUMPER] = stamp, jumper
    if stamp + stream[_SHIFT] <= before:
        return False
    own, other = stamp - stream[_AFTER], jumper - stream[_JUMPER]
    was_late = stream[_AFTER] + stream[_SHIFT] < before - JITTER
    return not was_late or bool(other > 0.0 and other >= MIN_PACE * own)


@kernel
def _contradicts(shared: Array, stream: Array, stamp: float, fitting: float) -> bool:
    """Return whether a stamp contradicts the order; NaN as the `fitting` shift means that it jumps."""
    if not abs(stamp) <= LATEST:  # or NaN
        return True
    if np.isnan(fitting):
        continues = stream[_HOW] == BY_ORDER and 0.0 < stamp - stream[_NEWEST] <= JITTER
        return bool(stream[_BAD] >= MAX_SET and not continues)
    step, repeats = stamp - stream[_STAMP], stream[_REPEATS]
    if abs(step) <= RESOLUTION:
        moved = shared[_NOW] - stream[_SINCE] > MAX_ADVANCE
        if repeats >= MAX_REPEATS or (repeats >= 2.0 and moved):
            return True
    if stream[_JUMPED] != 0.0:  # late, from before the jump
        return False
    floor = max(stream[_TIME], shared[_NOW] - stream[_LAG]) - JITTER
    return bool(-JITTER <= step <= RESOLUTION and stamp + stream[_SHIFT] < floor)


@kernel
def _set(
    table: Array,
    shared: Array,
    stream_index: int,
    stamp: float,
    goals: tuple[float, float],
    entry: Array,
) -> int:
    """Update the shift of a stream that jumps; return 1 if its clock was set.

    `goals` are the expected time, and the shift in use that fits it, or NaN.
    """
    stream, (expected, fitting) = table[stream_index], goals
    step, before = stamp - stream[_STAMP], stream[_SHIFT]
    if not np.isnan(fitting):
        stream[_SHIFT] = fitting
    elif step < 0.0 or step > MAX_PAUSE:
        stream[_SHIFT] = expected - stamp
    if stream[_SHIFT] != before:
        stream[_HOW] = CLOCK_SET
    if step < 0.0 and shared[_JUMP] and shared[_JUMP_STAMP] == stream[_STAMP]:  # a wrong stamp
        _refute(table, shared)
    elif stream[_SHIFT] != before:
        stream[_BAD] += 1.0
    if stream[_SHIFT] > before:
        entry[0], entry[1], entry[2] = stream_index, step - stream[_PERIOD], stamp
        return 1
    return 0


@kernel
def _refute(table: Array, shared: Array) -> None:
    """Record that the newest jump was not a pause."""
    if shared[_JUMP] > 0.0:
        table[int(shared[_JUMP_STREAM]), _BAD] += 1.0
        shared[_EXCESS] += shared[_JUMP]
        shared[_JUMP] = 0.0


@kernel
def _judge(stream: Array, contradicts: bool) -> None:
    """Update the share of stamps that contradict the order; use this row by order if its stamp does."""
    stream[_ROWS] += 1.0
    stream[_SHARE] += (contradicts - stream[_SHARE]) / min(stream[_ROWS], MEMORY)
    if contradicts:
        stream[_BAD] += 1.0
        stream[_HOW] = BY_ORDER
        if stream[_BAD] >= MAX_SET and stream[_SHARE] > DISTRUST:
            stream[_DISTRUSTED] = 1.0


@kernel
def _reconsider(table: Array, shared: Array, stream: Array, stamp: float) -> None:
    """Judge a stamp of a stream that is used by order; believe it if its stamps run again."""
    step, advance = stamp - stream[_NEWEST], shared[_NOW] - stream[_SINCE]
    runs = RESOLUTION < step <= MAX_PERIOD or (step > RESOLUTION and abs(step - advance) <= JITTER)
    _judge(stream, not runs)
    stream[_SINCE] = shared[_NOW]
    if stream[_SHARE] >= TRUST:
        return
    now = shared[_NOW] if shared[_NOW] > -np.inf else stamp
    shift = _nearest(table, stamp, now, now - JITTER, now + JITTER)
    stream[_SHIFT] = now - stamp if np.isnan(shift) else shift
    stream[_HOW], stream[_DISTRUSTED], stream[_REPEATS] = BY_STAMP, 0.0, 0.0


@kernel
def _advance(table: Array, shared: Array, stream_index: int, stamp: float) -> None:
    """Advance the time to a stamp of a stream."""
    stream = table[stream_index]
    time = stamp + stream[_SHIFT]
    if time > max(shared[_NOW], stream[_TIME] + stream[_PERIOD]) + JUMP:
        shared[_JUMP_STREAM], shared[_JUMP_STAMP] = stream_index, stamp
        shared[_JUMP_BEFORE] = shared[_NOW]
        jump = time - _expected(stream, shared[_NOW])
        shared[_JUMP] = jump if stream[_ROWS] > 1.0 else 0.0
        for i in range(len(table)):
            if i != stream_index:
                table[i, _JUMPED] += jump
                table[i, _AFTER] = np.nan
    if time >= shared[_FIRST] - JITTER or shared[_FIRST] == np.inf:  # else by another clock
        shared[_FIRST] = min(shared[_FIRST], time)
    shared[_NOW] = max(shared[_NOW], time)
    stream[_STAMP], stream[_TIME] = stamp, max(stream[_TIME], time)
    stream[_LAG] = shared[_NOW] - time
