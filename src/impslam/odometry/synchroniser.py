"""Assign the motion from odometry to sweeps, in the order of the log.

Motions are kept until a sweep needs them. A sweep waits until odometry covers its end, or until
odometry has the same stamp (both were then recorded together, and all motion belongs before the sweep),
but for at most `MAX_WAIT` rows of any stream. In a recorded log whose odometry has been on time before, it
also waits for `MAX_LATE` s of later sweeps, unless odometry resumes after a gap in its stamps: then it was
missing, not late. If the stamp of a sweep is later than its end, it also waits for odometry to reach the
stamp, until none has come for `MAX_WAIT` rows. It gets the motion from the middle of the previous sweep to
its own middle. A motion that spans the middle is split there, at constant twist.

Where stamps are unusable (see `clocks`), a sweep gets all odometry before it in the log, and does not wait.

Motions are kept and composed in `timeline`.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from impslam.columns import Motions
from impslam.geometry.kernels import kernel
from impslam.noise import MAX_GAP
from impslam.odometry.timeline import (
    ARRIVED,
    BEHIND,
    COVARIANCE,
    DURATION,
    LAST,
    NEWEST,
    POSE,
    SQUARE,
    SWEEP,
    UNAWAITED,
    WIDTH,
    advance,
    append,
    begin,
    compose,
    compose_all,
    consume,
    invert,
    mean_twist,
)
from impslam.types import Array, Increment, Ints, Mask

MAX_WAIT = 25
"""Rows of the log after which a sweep waits no longer for odometry and is used with the motion so far."""
ON_TIME = 0.2
"""s that odometry on time may be behind a sweep that comes. If it always is farther behind, two computers
may have different clocks, and by their stamps, sweeps would get the motion of another time."""
MAX_LATE = 30.0
"""s by which odometry may come later in a log than sweeps of the same time: recorders store messages as
they arrive, and radio links deliver them in blocks. A live robot does not wait for it."""
MAX_DELAY = 10.0
"""s from the end of a sweep to its stamp, of clocks of two computers that nothing synchronises. Odometry is
awaited for so long, and the diagnosis searches for such delays; a later stamp is one of another clock."""
MAX_MOTIONS = 20_000
"""Motions that are stored separately: 200 s of odometry at 100 Hz without a sweep. Beyond that the older
half is merged into one, so that a lidar that is silent for hours does not fill the memory."""
MIN_DURATION = 1e-6
"""s that rounding may take from a motion: stamps of this century are exact to 2e-7 s."""
END = np.iinfo(np.int64).max
"""A position after the end of any log."""

_State: TypeAlias = tuple[Array, Ints, Array]  # pending, ring, marks
_Odometry: TypeAlias = tuple[Ints, Array, Array, Array, Array]  # order, `Motions`
_Sweeps: TypeAlias = tuple[Ints, Array, Array, Array, Mask, Mask]  # `PendingSweeps`


class PendingSweeps(NamedTuple):
    """Sweeps in the order of the log that wait for odometry.

    Attributes
    ----------
    order : (w,) strictly increasing, position in the log
    begins, ends, stamps : (w,) s on the common time line
    usable : (w,) whether each gets motion; the others wait in order and are skipped
    by_order : (w,) whether each gets the motions before it in the log, whatever their stamps
    """

    order: Ints
    begins: Array
    ends: Array
    stamps: Array
    usable: Mask
    by_order: Mask

    def take(self, rows: slice | Ints | Mask) -> PendingSweeps:
        """Return some of the sweeps."""
        return PendingSweeps._make(column[rows] for column in self)


class Synchronised(NamedTuple):
    """The motions of the first r pending sweeps; rows of unusable sweeps are undefined.

    Attributes
    ----------
    motions : (r,) from the middle of the previous usable sweep to the middle of each
    twists : (r, 3) mean body velocity over the sweep
    T_middle_stamp, stamp_covariance : (r, 3), (r, 3, 3) motion from the middle to the stamp
    """

    motions: Motions
    twists: Array
    T_middle_stamp: Array
    stamp_covariance: Array

    def take(self, rows: Ints) -> Synchronised:
        """Return some of the rows."""
        motions, *columns = self
        return Synchronised(motions.take(rows), *(column[rows] for column in columns))


class Synchroniser:
    """Keeps the motion that no sweep has used yet, in arrays that kernels update from batch to batch.

    Attributes
    ----------
    max_late : s of later sweeps for which a sweep waits for odometry, besides `MAX_WAIT` rows
    """

    def __init__(self, max_motions: int = MAX_MOTIONS) -> None:
        self._state = begin(max_motions)
        self.max_late = MAX_LATE

    def feed(
        self, order: Ints, motions: Motions, pending: PendingSweeps, last: int
    ) -> Synchronised:
        """Add the motions of odometry rows, and return the motions of the sweeps that they cover.

        Parameters
        ----------
        order : (m,) positions of the odometry rows in the log
        motions : (m,) to each row, on the common time line; NaN where unknown: odometry
            restarts at that stamp
        pending : sweeps of earlier batches and of this one
        last : position in the log of the newest row of any stream; `END` at the end of the log
        """
        out = np.empty((len(pending.order), 2 * WIDTH + 3))
        wait = (last, self.max_late)
        count = _synchronise(self._state, (order, *motions), pending[:], wait, out)
        return _unpacked(out[:count], 0.5 * (pending.begins[:count] + pending.ends[:count]))

    def ahead(self) -> Increment:
        """Return the motion since the middle of the newest sweep, without removing it."""
        total = np.zeros(WIDTH)
        pending, ring, marks = self._state
        compose_all(pending, ring, total)
        pose = total[POSE:COVARIANCE]
        return Increment(
            float(marks[NEWEST]), pose, _squares(total[None])[0], float(total[DURATION])
        )


def _unpacked(out: Array, middles: Array) -> Synchronised:
    motion, twists, middle_to_stamp = out[:, :WIDTH], out[:, WIDTH : WIDTH + 3], out[:, WIDTH + 3 :]
    motions = Motions(middles, _poses(motion), _squares(motion), motion[:, DURATION].copy())
    return Synchronised(motions, twists.copy(), _poses(middle_to_stamp), _squares(middle_to_stamp))


def _poses(rows: Array) -> Array:
    return rows[:, POSE:COVARIANCE].copy()


def _squares(rows: Array) -> Array:
    """Return (r, 3, 3) covariances from their distinct entries."""
    entries: Array = rows.take(SQUARE, axis=1)
    return entries.reshape(-1, 3, 3)


@kernel
def _use(state: _State, begin: float, end: float, stamp: float, by_order: bool, out: Array) -> None:
    """Write a sweep's motion, its twist, and the motion from its middle to its stamp."""
    pending, ring, marks = state
    middle, last = 0.5 * (begin + end), marks[LAST]
    motion, since, ahead = out[:WIDTH], np.zeros(WIDTH), np.zeros(WIDTH)
    motion[:] = 0.0
    consume(pending, ring, begin, by_order or begin == last, motion, False)
    mean_twist(pending, ring, marks, begin, end - begin, out[WIDTH : WIDTH + 3])
    until = min(max(begin, stamp), middle)
    consume(pending, ring, until, until == last, motion, False)
    consume(pending, ring, middle, middle == last, since, False)
    compose(motion, since)
    middle_to_stamp = out[WIDTH + 3 :]
    middle_to_stamp[:] = 0.0
    # For a sweep that overlaps the last one, the motion up to the last one's middle is already used.
    missing = middle - until - since[DURATION]
    if missing > MIN_DURATION and marks[NEWEST] >= middle:
        before = np.zeros(WIDTH)
        advance(out[WIDTH : WIDTH + 3], missing, before)
        compose(before, since)
        since[:] = before
    if middle != stamp:
        consume(pending, ring, stamp, stamp == last, ahead, True)
        invert(since, middle_to_stamp)
        covariance = since[COVARIANCE:] + ahead[COVARIANCE:]
        compose(middle_to_stamp, ahead)
        middle_to_stamp[COVARIANCE:] = covariance


@kernel
def _ready(marks: Array, begin: float, end: float, stamp: float, order: int, last_row: int) -> bool:
    """Return whether a sweep can be used now."""
    together = begin == end and stamp == marks[LAST]
    if together or marks[NEWEST] >= max(end, stamp):
        return True
    is_covered = marks[NEWEST] >= end  # but its stamp is not
    since = max(float(order), marks[ARRIVED]) if is_covered else float(order)
    may_come = not is_covered and order > marks[UNAWAITED]
    return last_row - since >= MAX_WAIT and not may_come


@kernel
def _append_motion(state: _State, odometry: _Odometry, k: int) -> None:
    """Add the motion of row k of odometry."""
    pending, ring, marks = state
    order, stamps, d_poses, covariances, durations = odometry
    marks[ARRIVED] = order[k]
    if np.isnan(d_poses[k, 0]):
        marks[LAST] = stamps[k]
        marks[NEWEST] = max(marks[NEWEST], stamps[k])
    else:
        append(pending, ring, marks, stamps[k], d_poses[k], covariances[k], durations[k])


@kernel
def _release(
    state: _State, sweeps: _Sweeps, used: int, arrived: int, last_row: int, out: Array
) -> int:
    """Use the sweeps from index `used` on that are ready; return the new number of used sweeps."""
    order, begins, ends, stamps, usable, by_order = sweeps
    while used < arrived:
        begin, end, stamp = begins[used], ends[used], stamps[used]
        ready = by_order[used] or _ready(state[2], begin, end, stamp, order[used], last_row)
        if not ready:
            break
        if usable[used]:
            _use(state, begin, end, stamp, by_order[used], out[used])
        used += 1
    return used


@kernel
def _arrive(marks: Array, sweeps: _Sweeps, waited: Array, k: int, max_late: float) -> None:
    """Update the marks at the arrival of sweep k; `waited` as in `_waiting_time`."""
    order, end, is_by_order = sweeps[0], sweeps[2][k], sweeps[5][k]
    if order[k] <= marks[SWEEP]:  # it has waited in an earlier batch
        return
    marks[SWEEP] = order[k]
    marks[BEHIND] = min(marks[BEHIND], max(end - marks[NEWEST], 0.0))
    if is_by_order or marks[BEHIND] > ON_TIME:  # the stamps of those before it were wrong, too
        marks[UNAWAITED] = max(marks[UNAWAITED], order[k])
    for i in range(k, -1, -1):
        if waited[k] - waited[i] >= max_late:
            marks[UNAWAITED] = max(marks[UNAWAITED], order[i])
            break


@kernel
def _synchronise(
    state: _State, odometry: _Odometry, sweeps: _Sweeps, wait: tuple[int, float], out: Array
) -> int:
    """Process odometry rows and sweeps in the order of the log; return the number of used sweeps.

    Rows of other streams only count as waiting time: a sweep that reaches `MAX_WAIT` between two rows
    is used before the later one. `wait` are the newest row of any stream, and the longest wait for late
    odometry, s.
    """
    odometry_order, sweep_order, marks = odometry[0], sweeps[0], state[2]
    waited, durations, (last, max_late) = _waiting_time(sweeps[2]), odometry[4], wait
    used, arrived, k = 0, 0, 0
    while k < len(odometry_order) or arrived < len(sweep_order):
        now = odometry_order[k] if k < len(odometry_order) else END
        if arrived < len(sweep_order):
            now = min(now, sweep_order[arrived])
        has_row = k < len(odometry_order) and odometry_order[k] == now
        if has_row and durations[k] > MAX_GAP:
            marks[UNAWAITED] = marks[SWEEP]
        used = _release(state, sweeps, used, arrived, now - 1, out)
        if has_row:
            _append_motion(state, odometry, k)
            k += 1
        if arrived < len(sweep_order) and sweep_order[arrived] == now:
            _arrive(marks, sweeps, waited, arrived, max_late)
            arrived += 1
    if last == END:
        marks[UNAWAITED] = marks[SWEEP]
    return _release(state, sweeps, used, arrived, last, out)


@kernel
def _waiting_time(ends: Array) -> Array:
    """Return the time (w,) s of sweeps with these ends, in which gaps count as `MAX_GAP`."""
    out = np.zeros(len(ends))
    for k in range(1, len(ends)):
        out[k] = out[k - 1] + min(max(ends[k] - ends[k - 1], 0.0), MAX_GAP)
    return out
