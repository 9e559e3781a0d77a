"""A ring buffer of motions that no sweep has used yet; kernels compose, split and remove them in place.

A row holds the stamp at the end of a motion, its duration, its pose [x, y, theta] and the six distinct
entries of the covariance of the additive error. Motions are composed to first order, as in
`geometry.se2.compose_uncertain`; the formulas are repeated here because this code runs for every row
of odometry.

Time never runs backwards: a motion with a stamp before the newest one is kept with duration 0. Logs
whose stamps jitter are therefore used in the order of the log.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import sinc_cosc
from impslam.types import Array, Ints

# Columns of a motion: the stamp at its end, duration, pose (3), covariance xx, xy, xt, yy, yt, tt.
WIDTH = 11
STAMP, DURATION, POSE, THETA, COVARIANCE = 0, 1, 2, 4, 5
SQUARE = COVARIANCE + np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])  # the nine entries of the covariance
# Marks: the newest time, the newest stamp, the newest motion that took time (duration, pose), and the
# position in the log of the newest row. Of the sweeps, the least time by which odometry was behind one when
# it came; the position of the newest one, and of the newest that does not wait for late odometry.
NEWEST, LAST, LATEST, ARRIVED, BEHIND, SWEEP, UNAWAITED = 0, 1, 2, 6, 7, 8, 9
MARKS = 10


def begin(max_motions: int) -> tuple[Array, Ints, Array]:
    """Return an empty ring of at most `max_motions` motions, its start and length (2,), and the marks."""
    marks = np.zeros(MARKS)
    marks[[NEWEST, LAST, ARRIVED, SWEEP, UNAWAITED]] = -np.inf
    marks[BEHIND] = np.inf
    return np.empty((max_motions + 1, WIDTH)), np.zeros(2, np.int64), marks


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
def compose(total: Array, other: Array) -> None:
    """Compose a motion with a later one, in place; both are rows (`WIDTH`,) of the ring."""
    c, s = math.cos(total[THETA]), math.sin(total[THETA])
    dx, dy = c * other[2] - s * other[3], s * other[2] + c * other[3]
    _carry_covariance(total[COVARIANCE:], dx, dy)
    _add_turned(total[COVARIANCE:], other[COVARIANCE:], c, s, 1.0)
    total[2] += dx
    total[3] += dy
    total[THETA] = wrap_in_kernel(total[THETA] + other[THETA])
    total[DURATION] += other[DURATION]
    total[STAMP] = other[STAMP]


@kernel
def _log(pose: Array, out: Array) -> None:
    """Write the twist that reaches a pose in 1 s; see `geometry.se2.log`."""
    theta = wrap_in_kernel(pose[2])
    a, b = sinc_cosc(theta)
    scale = 1.0 / (a * a + b * b)
    out[0] = scale * (a * pose[0] + b * pose[1])
    out[1] = scale * (a * pose[1] - b * pose[0])
    out[2] = theta


@kernel
def _exp(twist: Array, share: float, out: Array) -> None:
    """Write the pose that part of a twist reaches in 1 s; see `geometry.se2.exp`."""
    vx, vy, theta = share * twist[0], share * twist[1], share * twist[2]
    a, b = sinc_cosc(theta)
    out[0], out[1], out[2] = a * vx - b * vy, b * vx + a * vy, wrap_in_kernel(theta)


@kernel
def _split(whole: Array, fraction: float, head: Array, tail: Array) -> None:
    """Split a motion at a fraction of its duration, at constant twist.

    Each part has its share of the covariance, pulled back through the composition of the two, so
    that `compose` restores it. `tail` may be `whole` itself.
    """
    twist, P = np.empty(3), whole[COVARIANCE:].copy()
    _log(whole[POSE:COVARIANCE], twist)
    cut, rest = fraction * whole[DURATION], whole[DURATION] - fraction * whole[DURATION]
    head[STAMP], head[DURATION] = whole[STAMP] - whole[DURATION] + cut, cut
    tail[STAMP], tail[DURATION] = whole[STAMP], rest
    _exp(twist, fraction, head[POSE:COVARIANCE])
    _exp(twist, 1.0 - fraction, tail[POSE:COVARIANCE])
    c, s = math.cos(head[THETA]), math.sin(head[THETA])
    head[COVARIANCE:] = fraction * P
    _carry_covariance(head[COVARIANCE:], s * tail[3] - c * tail[2], -s * tail[2] - c * tail[3])
    tail[COVARIANCE:] = 0.0
    _add_turned(tail[COVARIANCE:], P, c, -s, 1.0 - fraction)


@kernel
def consume(
    pending: Array, ring: Ints, stamp: float, together: bool, total: Array, keep: bool
) -> None:
    """Compose `total` with the motion up to a stamp, or with all motion; remove it unless `keep`."""
    head = np.empty(WIDTH)
    rest = np.empty(WIDTH)
    at, count = ring[0], ring[1]
    while count > 0:
        first = pending[at]
        begin = first[STAMP] - first[DURATION]
        if not together and first[STAMP] > stamp:
            if begin < stamp:
                fraction = (stamp - begin) / first[DURATION]
                _split(first, fraction, head, rest if keep else first)
                compose(total, head)
            break
        compose(total, first)
        at, count = (at + 1) % len(pending), count - 1
    if not keep:
        ring[0], ring[1] = at, count


@kernel
def compose_all(pending: Array, ring: Ints, total: Array) -> None:
    """Compose `total` with all motion, without removing it."""
    for k in range(ring[1]):
        compose(total, pending[(ring[0] + k) % len(pending)])


@kernel
def _fold(pending: Array, ring: Ints) -> None:
    """Merge the older half of the motions into one."""
    half = (len(pending) - 1) // 2
    total = np.zeros(WIDTH)
    for k in range(half):
        compose(total, pending[(ring[0] + k) % len(pending)])
    ring[0], ring[1] = (ring[0] + half - 1) % len(pending), ring[1] - half + 1
    pending[ring[0]] = total


@kernel
def append(
    pending: Array, ring: Ints, marks: Array, stamp: float, d_pose: Array, P: Array, duration: float
) -> None:
    """Add the motion of a row of odometry: d_pose (3,) with covariance P (3, 3), in `duration` s."""
    used_duration = min(duration, max(stamp - marks[NEWEST], 0.0))
    marks[LAST] = stamp
    marks[NEWEST] = max(marks[NEWEST], stamp)
    row = pending[(ring[0] + ring[1]) % len(pending)]
    ring[1] += 1
    row[STAMP], row[DURATION] = marks[NEWEST], used_duration
    row[POSE:COVARIANCE] = d_pose
    row[5], row[6], row[7], row[8], row[9], row[10] = (
        P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    )  # fmt: skip
    if duration > 0.0:
        marks[LATEST] = duration
        marks[LATEST + 1 : ARRIVED] = d_pose
    if ring[1] == len(pending):
        _fold(pending, ring)


@kernel
def mean_twist(
    pending: Array, ring: Ints, marks: Array, stamp: float, duration: float, out: Array
) -> None:
    """Write the mean body twist over `duration` s after a stamp, (3,) in m/s, m/s, rad/s.

    It is from the pending motions, or else from the latest one that took time.
    """
    ahead = np.zeros(WIDTH)
    for k in range(ring[1]):
        row = pending[(ring[0] + k) % len(pending)]
        if row[STAMP] - row[DURATION] > stamp + duration:
            break
        compose(ahead, row)
    if ahead[DURATION] > 0.0 and ahead[DURATION] >= 0.5 * duration:
        _log(ahead[POSE:COVARIANCE], out)
        out /= ahead[DURATION]
    elif marks[LATEST] > 0.0:
        _log(marks[LATEST + 1 : ARRIVED], out)
        out /= marks[LATEST]
    else:
        out[:] = 0.0


@kernel
def advance(twist: Array, seconds: float, out: Array) -> None:
    """Write the pose and the duration after `seconds` at a constant twist (3,) m/s, m/s, rad/s."""
    out[DURATION] = seconds
    _exp(twist, seconds, out[POSE:COVARIANCE])


@kernel
def invert(motion: Array, out: Array) -> None:
    """Write the inverse of a motion's pose."""
    c, s = math.cos(motion[THETA]), math.sin(motion[THETA])
    out[2], out[3] = -c * motion[2] - s * motion[3], s * motion[2] - c * motion[3]
    out[THETA] = wrap_in_kernel(-motion[THETA])
