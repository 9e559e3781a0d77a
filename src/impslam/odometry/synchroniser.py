"""Sweeps brought onto the motion that odometry tells, in the order of the log.

Motions wait until a sweep asks for them. A sweep waits until odometry covers its end, at most
`MAX_WAIT` rows of the log, or until odometry has its own stamp: then they were recorded together, and
all motion belongs before it. It then gets the motion from the middle of the sweep before up to its own
middle; a motion across that moment is cut there, at constant twist.

Motions are kept and composed in `timeline`.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from impslam.columns import Motions
from impslam.geometry.kernels import kernel
from impslam.odometry.timeline import (
    COVARIANCE,
    DURATION,
    LAST,
    NEWEST,
    POSE,
    SQUARE,
    WIDTH,
    add_up,
    append,
    begin,
    consume,
    follow,
    invert,
    mean_twist,
)
from impslam.types import Array, Increment, Ints, Mask

MAX_WAIT = 25
"""Rows of the log that a sweep waits for odometry to reach its end; then it is used with what is known."""
MOST = 20_000
"""Motions kept apart: 200 s of odometry at 100 Hz without a sweep. Then the older half becomes one,
so that a robot whose lidar is silent for hours does not fill its memory."""
END = np.iinfo(np.int64).max
"""A place after the end of any log."""

_State: TypeAlias = tuple[Array, Ints, Array]  # pending, ring, marks
_Felt: TypeAlias = tuple[Ints, Array, Array, Array, Array]  # order, `Motions`
_Sweeps: TypeAlias = tuple[Ints, Array, Array, Array, Mask]  # `Waiting`


class Waiting(NamedTuple):
    """Sweeps in the order of the log that wait for odometry.

    Attributes
    ----------
    order : (w,) strictly increasing, place in the log
    begins, ends, stamps : (w,) s on the one time line
    usable : (w,) whether each may take motion; one that may not waits its turn and is passed over
    """

    order: Ints
    begins: Array
    ends: Array
    stamps: Array
    usable: Mask


class Synchronised(NamedTuple):
    """What the first r of the waiting sweeps got; rows of those that are not usable mean nothing.

    Attributes
    ----------
    motions : (r,) to the middle of each sweep from that of the usable one before
    twists : (r, 3) mean body velocity over the sweep
    T_middle_stamp, stamp_covariance : (r, 3), (r, 3, 3) motion from the middle to the stamp
    """

    motions: Motions
    twists: Array
    T_middle_stamp: Array
    stamp_covariance: Array


class Synchroniser:
    """The motion not yet handed on; its state is in arrays that kernels carry from batch to batch."""

    def __init__(self, most: int = MOST) -> None:
        self._state = begin(most)

    def feed(self, order: Ints, motions: Motions, waiting: Waiting, last: int) -> Synchronised:
        """Take in the motions that rows of odometry tell, and give sweeps theirs.

        Parameters
        ----------
        order : (m,) places of the rows in the log
        motions : (m,) to each row, on the one time line; NaN where none is known: odometry begins
            anew at that stamp
        waiting : sweeps of earlier batches and of this one
        last : place in the log of the newest row of any stream; `END` if the log is over
        """
        out = np.empty((len(waiting.order), 2 * WIDTH + 3))
        count = _synchronise(self._state, (order, *motions), waiting[:], last, out)
        return _unpacked(out[:count], 0.5 * (waiting.begins[:count] + waiting.ends[:count]))

    def ahead(self) -> Increment:
        """Return all motion since the middle of the newest sweep, and leave it here."""
        total = np.zeros(WIDTH)
        pending, ring, marks = self._state
        add_up(pending, ring, total)
        pose = total[POSE:COVARIANCE]
        return Increment(
            float(marks[NEWEST]), pose, _squares(total[None])[0], float(total[DURATION])
        )


def _unpacked(out: Array, middles: Array) -> Synchronised:
    motion, twists, on = out[:, :WIDTH], out[:, WIDTH : WIDTH + 3], out[:, WIDTH + 3 :]
    motions = Motions(middles, _poses(motion), _squares(motion), motion[:, DURATION].copy())
    return Synchronised(motions, twists.copy(), _poses(on), _squares(on))


def _poses(rows: Array) -> Array:
    return rows[:, POSE:COVARIANCE].copy()


def _squares(rows: Array) -> Array:
    """Return (r, 3, 3) covariances from their distinct entries."""
    entries: Array = rows.take(SQUARE, axis=1)
    return entries.reshape(-1, 3, 3)


@kernel
def _use(
    pending: Array, ring: Ints, marks: Array, begin: float, end: float, stamp: float, out: Array
) -> None:
    """Write a sweep's motion, its twist, and the motion from its middle to its stamp."""
    middle, last = 0.5 * (begin + end), marks[LAST]
    motion, since, ahead = out[:WIDTH], np.zeros(WIDTH), np.zeros(WIDTH)
    motion[:] = 0.0
    consume(pending, ring, begin, begin == last, motion, False)
    mean_twist(pending, ring, marks, begin, end - begin, out[WIDTH : WIDTH + 3])
    until = min(max(begin, stamp), middle)
    consume(pending, ring, until, until == last, motion, False)
    consume(pending, ring, middle, middle == last, since, False)
    follow(motion, since)
    on = out[WIDTH + 3 :]
    on[:] = 0.0
    if middle != stamp:
        consume(pending, ring, stamp, stamp == last, ahead, True)
        invert(since, on)
        on_P = since[COVARIANCE:] + ahead[COVARIANCE:]
        follow(on, ahead)
        on[COVARIANCE:] = on_P


@kernel
def _ready(marks: Array, begin: float, end: float, stamp: float, waited: int) -> bool:
    """Tell whether a sweep need not wait for more odometry."""
    together = begin == end and stamp == marks[LAST]
    return together or marks[NEWEST] >= max(end, stamp) or waited >= MAX_WAIT


@kernel
def _feel(state: _State, odometry: _Felt, k: int) -> None:
    """Take in row k of odometry."""
    pending, ring, marks = state
    _, stamps, d_poses, covariances, durations = odometry
    if np.isnan(d_poses[k, 0]):
        marks[LAST] = stamps[k]
        marks[NEWEST] = max(marks[NEWEST], stamps[k])
    else:
        append(pending, ring, marks, stamps[k], d_poses[k], covariances[k], durations[k])


@kernel
def _release(state: _State, sweeps: _Sweeps, done: int, come: int, seen: int, out: Array) -> int:
    """Use sweeps from the `done`-th on that need not wait; return how many are done then."""
    pending, ring, marks = state
    order, begins, ends, stamps, usable = sweeps
    while done < come:
        begin, end, stamp = begins[done], ends[done], stamps[done]
        if not _ready(marks, begin, end, stamp, seen - order[done]):
            break
        if usable[done]:
            _use(pending, ring, marks, begin, end, stamp, out[done])
        done += 1
    return done


@kernel
def _synchronise(state: _State, odometry: _Felt, sweeps: _Sweeps, last: int, out: Array) -> int:
    """Go through rows of odometry and sweeps in the order of the log; return how many sweeps are used.

    Rows of other streams change nothing but how long a sweep has waited: one whose patience ends
    between two rows is used before the later of them.
    """
    felt_order, sweep_order = odometry[0], sweeps[0]
    done, come, k = 0, 0, 0
    while k < len(felt_order) or come < len(sweep_order):
        now = felt_order[k] if k < len(felt_order) else END
        if come < len(sweep_order):
            now = min(now, sweep_order[come])
        done = _release(state, sweeps, done, come, now - 1, out)
        if k < len(felt_order) and felt_order[k] == now:
            _feel(state, odometry, k)
            k += 1
        if come < len(sweep_order) and sweep_order[come] == now:
            come += 1
    return _release(state, sweeps, done, come, last, out)
