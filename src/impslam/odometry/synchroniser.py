"""Sweeps brought onto the motion that odometry tells, in the order of the log.

Motions wait until a sweep asks for them. A sweep waits until odometry covers its end, at most
`MAX_WAIT` rows of the log, or until odometry has its own stamp: then they were recorded together, and
all motion belongs before it. It then gets the motion from the middle of the sweep before up to its own
middle; a motion across that moment is cut there, at constant twist.

Time never runs backwards here: a motion whose stamp lies before the newest one is kept and takes no
time. So logs whose stamps jitter are used in the order of the log.

Composition, with its covariance to first order in an additive error, is that of
`geometry.se2.compose_uncertain`; here it is written out for [x, y, theta] and the six distinct entries of
the covariance, in place, because every row of odometry passes through it.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from impslam.columns import Motions
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array, Increment, Ints, Mask

MAX_WAIT = 25
"""Rows of the log that a sweep waits for odometry to reach its end; then it is used with what is known."""
MOST = 20_000
"""Motions kept apart: 200 s of odometry at 100 Hz without a sweep. Then the older half becomes one,
so that a robot whose lidar is silent for hours does not fill its memory."""
END = np.iinfo(np.int64).max
"""A place after the end of any log."""

# Columns of a motion: the stamp at its end, duration, pose (3), covariance xx, xy, xt, yy, yt, tt.
_WIDTH = 11
_STAMP, _DURATION, _POSE, _THETA, _COVARIANCE = 0, 1, 2, 4, 5
# Marks: the newest time, the newest stamp, and the newest motion that took time (duration, pose).
_NEWEST, _LAST, _LATEST = 0, 1, 2
_MARKS = 6
_SQUARE = _COVARIANCE + np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])

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
        self._pending = np.empty((most + 1, _WIDTH))  # a ring
        self._ring = np.zeros(2, np.int64)  # where it begins, and how many are in it
        self._marks = np.zeros(_MARKS)
        self._marks[:2] = -np.inf

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
        out = np.empty((len(waiting.order), 2 * _WIDTH + 3))
        state = (self._pending, self._ring, self._marks)
        count = _synchronise(state, (order, *motions), waiting[:], last, out)
        return _unpacked(out[:count], 0.5 * (waiting.begins[:count] + waiting.ends[:count]))

    def ahead(self) -> Increment:
        """Return all motion since the middle of the newest sweep, and leave it here."""
        total = np.zeros(_WIDTH)
        _total(self._pending, self._ring, total)
        newest = float(self._marks[_NEWEST])
        pose = total[_POSE:_COVARIANCE]
        return Increment(newest, pose, _squares(total[None])[0], float(total[_DURATION]))


def _unpacked(out: Array, middles: Array) -> Synchronised:
    motion, twists, on = out[:, :_WIDTH], out[:, _WIDTH : _WIDTH + 3], out[:, _WIDTH + 3 :]
    motions = Motions(middles, _poses(motion), _squares(motion), motion[:, _DURATION].copy())
    return Synchronised(motions, twists.copy(), _poses(on), _squares(on))


def _poses(rows: Array) -> Array:
    return rows[:, _POSE:_COVARIANCE].copy()


def _squares(rows: Array) -> Array:
    """Return (r, 3, 3) covariances from their distinct entries."""
    return rows.take(_SQUARE, axis=1).reshape(-1, 3, 3)


# --------------------------------------------------------------------------- kernels


@kernel
def _carry_covariance(P: Array, dx: float, dy: float) -> None:
    """F P F^T in place; F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]], a further motion [dx, dy] in map."""
    P[2] -= dy * P[5]
    P[0] -= dy * (2.0 * P[2] + dy * P[5])
    yt = P[4] + dx * P[5]
    P[1] += dx * P[2] - dy * P[4]
    P[3] += dx * (P[4] + yt)
    P[4] = yt


@kernel
def _add_turned(P: Array, Q: Array, c: float, s: float, share: float) -> None:
    """P + share S Q S^T in place; S turns x and y by the angle with this cosine and sine."""
    a, b = c * Q[0] - s * Q[1], c * Q[1] - s * Q[3]
    e, f = s * Q[0] + c * Q[1], s * Q[1] + c * Q[3]
    P[0] += share * (c * a - s * b)
    P[1] += share * (s * a + c * b)
    P[3] += share * (s * e + c * f)
    P[2] += share * (c * Q[2] - s * Q[4])
    P[4] += share * (s * Q[2] + c * Q[4])
    P[5] += share * Q[5]


@kernel
def _then(total: Array, other: Array) -> None:
    """Let a motion be followed by another, in place."""
    c, s = math.cos(total[_THETA]), math.sin(total[_THETA])
    dx, dy = c * other[2] - s * other[3], s * other[2] + c * other[3]
    _carry_covariance(total[_COVARIANCE:], dx, dy)
    _add_turned(total[_COVARIANCE:], other[_COVARIANCE:], c, s, 1.0)
    total[2] += dx
    total[3] += dy
    total[_THETA] = wrap_in_kernel(total[_THETA] + other[_THETA])
    total[_DURATION] += other[_DURATION]
    total[_STAMP] = other[_STAMP]


@kernel
def _log(pose: Array, out: Array) -> None:
    """Write the twist that reaches a pose in 1 s; see `geometry.se2.log`."""
    theta = wrap_in_kernel(pose[2])
    if abs(theta) < 1e-4:
        a, b = 1.0 - theta * theta / 6.0, theta / 2.0 - theta**3 / 24.0
    else:
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta
    scale = 1.0 / (a * a + b * b)
    out[0] = scale * (a * pose[0] + b * pose[1])
    out[1] = scale * (a * pose[1] - b * pose[0])
    out[2] = theta


@kernel
def _exp(twist: Array, share: float, out: Array) -> None:
    """Write the pose that part of a twist reaches in 1 s; see `geometry.se2.exp`."""
    vx, vy, theta = share * twist[0], share * twist[1], share * twist[2]
    if abs(theta) < 1e-4:
        a, b = 1.0 - theta * theta / 6.0, theta / 2.0 - theta**3 / 24.0
    else:
        a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta
    out[0], out[1], out[2] = a * vx - b * vy, b * vx + a * vy, wrap_in_kernel(theta)


@kernel
def _split(whole: Array, fraction: float, head: Array, tail: Array) -> None:
    """Cut a motion at a fraction of its time, at constant twist; see `Increment.split`.

    Each part has its share of the covariance, pulled back through the composition of the two, so
    that `_then` restores it. `tail` may be `whole` itself.
    """
    twist, P = np.empty(3), whole[_COVARIANCE:].copy()
    _log(whole[_POSE:_COVARIANCE], twist)
    cut, rest = fraction * whole[_DURATION], whole[_DURATION] - fraction * whole[_DURATION]
    head[_STAMP], head[_DURATION] = whole[_STAMP] - whole[_DURATION] + cut, cut
    tail[_STAMP], tail[_DURATION] = whole[_STAMP], rest
    _exp(twist, fraction, head[_POSE:_COVARIANCE])
    _exp(twist, 1.0 - fraction, tail[_POSE:_COVARIANCE])
    c, s = math.cos(head[_THETA]), math.sin(head[_THETA])
    head[_COVARIANCE:] = fraction * P
    _carry_covariance(head[_COVARIANCE:], s * tail[3] - c * tail[2], -s * tail[2] - c * tail[3])
    tail[_COVARIANCE:] = 0.0
    _add_turned(tail[_COVARIANCE:], P, c, -s, 1.0 - fraction)


@kernel
def _consume(
    pending: Array, ring: Ints, stamp: float, together: bool, total: Array, keep: bool
) -> None:
    """Append the motion up to a stamp, or all of it, to `total`; remove it unless it is to be kept."""
    head = np.empty(_WIDTH)
    rest = np.empty(_WIDTH)
    at, count = ring[0], ring[1]
    while count > 0:
        first = pending[at]
        begin = first[_STAMP] - first[_DURATION]
        if not together and first[_STAMP] > stamp:
            if begin < stamp:
                fraction = (stamp - begin) / first[_DURATION]
                _split(first, fraction, head, rest if keep else first)
                _then(total, head)
            break
        _then(total, first)
        at, count = (at + 1) % len(pending), count - 1
    if not keep:
        ring[0], ring[1] = at, count


@kernel
def _total(pending: Array, ring: Ints, total: Array) -> None:
    """Append all motion to `total` and leave it."""
    for k in range(ring[1]):
        _then(total, pending[(ring[0] + k) % len(pending)])


@kernel
def _fold(pending: Array, ring: Ints) -> None:
    """Make the older half of the motions one."""
    half = (len(pending) - 1) // 2
    total = np.zeros(_WIDTH)
    for k in range(half):
        _then(total, pending[(ring[0] + k) % len(pending)])
    ring[0], ring[1] = (ring[0] + half - 1) % len(pending), ring[1] - half + 1
    pending[ring[0]] = total


@kernel
def _append(
    pending: Array, ring: Ints, marks: Array, stamp: float, d_pose: Array, P: Array, duration: float
) -> None:
    """Take in the motion that a row of odometry told."""
    taken = min(duration, max(stamp - marks[_NEWEST], 0.0))
    marks[_LAST] = stamp
    marks[_NEWEST] = max(marks[_NEWEST], stamp)
    row = pending[(ring[0] + ring[1]) % len(pending)]
    ring[1] += 1
    row[_STAMP], row[_DURATION] = marks[_NEWEST], taken
    row[_POSE:_COVARIANCE] = d_pose
    row[5], row[6], row[7], row[8], row[9], row[10] = (
        P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    )  # fmt: skip
    if duration > 0.0:
        marks[_LATEST] = duration
        marks[_LATEST + 1 :] = d_pose
    if ring[1] == len(pending):
        _fold(pending, ring)


@kernel
def _twist(
    pending: Array, ring: Ints, marks: Array, stamp: float, duration: float, out: Array
) -> None:
    """Write the mean body twist from a stamp on, of what is pending, or the latest one."""
    ahead = np.zeros(_WIDTH)
    for k in range(ring[1]):
        row = pending[(ring[0] + k) % len(pending)]
        if row[_STAMP] - row[_DURATION] > stamp + duration:
            break
        _then(ahead, row)
    if ahead[_DURATION] > 0.0 and ahead[_DURATION] >= 0.5 * duration:
        _log(ahead[_POSE:_COVARIANCE], out)
        out /= ahead[_DURATION]
    elif marks[_LATEST] > 0.0:
        _log(marks[_LATEST + 1 :], out)
        out /= marks[_LATEST]
    else:
        out[:] = 0.0


@kernel
def _use(
    pending: Array, ring: Ints, marks: Array, begin: float, end: float, stamp: float, out: Array
) -> None:
    """Write a sweep's motion, its twist, and the motion from its middle to its stamp."""
    middle, last = 0.5 * (begin + end), marks[_LAST]
    motion, since, ahead = out[:_WIDTH], np.zeros(_WIDTH), np.zeros(_WIDTH)
    motion[:] = 0.0
    _consume(pending, ring, begin, begin == last, motion, False)
    _twist(pending, ring, marks, begin, end - begin, out[_WIDTH : _WIDTH + 3])
    until = min(max(begin, stamp), middle)
    _consume(pending, ring, until, until == last, motion, False)
    _consume(pending, ring, middle, middle == last, since, False)
    _then(motion, since)
    on = out[_WIDTH + 3 :]
    on[:] = 0.0
    if middle != stamp:
        _consume(pending, ring, stamp, stamp == last, ahead, True)
        _invert(since, on)
        on_P = since[_COVARIANCE:] + ahead[_COVARIANCE:]
        _then(on, ahead)
        on[_COVARIANCE:] = on_P


@kernel
def _invert(motion: Array, out: Array) -> None:
    """Write the inverse of a motion's pose."""
    c, s = math.cos(motion[_THETA]), math.sin(motion[_THETA])
    out[2], out[3] = -c * motion[2] - s * motion[3], s * motion[2] - c * motion[3]
    out[_THETA] = wrap_in_kernel(-motion[_THETA])


@kernel
def _ready(marks: Array, begin: float, end: float, stamp: float, waited: int) -> bool:
    """Tell whether a sweep need not wait for more odometry."""
    together = begin == end and stamp == marks[_LAST]
    return together or marks[_NEWEST] >= max(end, stamp) or waited >= MAX_WAIT


@kernel
def _feel(state: _State, odometry: _Felt, k: int) -> None:
    """Take in row k of odometry."""
    pending, ring, marks = state
    _, stamps, d_poses, covariances, durations = odometry
    if np.isnan(d_poses[k, 0]):
        marks[_LAST] = stamps[k]
        marks[_NEWEST] = max(marks[_NEWEST], stamps[k])
    else:
        _append(pending, ring, marks, stamps[k], d_poses[k], covariances[k], durations[k])


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
