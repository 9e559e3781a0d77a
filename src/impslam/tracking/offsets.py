"""Check the heading of the lidar's mount and its clock against odometry while the robot drives.

A mount that turned, or a clock that is late, leaves every scan in agreement with the map, so no single scan
shows it. The motions do: a lidar turned by d reports a sideways motion of -sin(d) per metre ahead, and a
lidar whose stamps are late reports each turn later than odometry. The turns of odometry are therefore
compared with those of the scans at several lags. At the lag of the stamps, their products are largest,
and what a fitted scale leaves of the turns is smaller than at small lags. Both are required:
interpolation makes odometry less noisy between matches, which reduces what is left, and a window that
ends in a turn has more of it at some lags, which increases the products. Without the scale, wheels that
slip in a turn would be late or early where it begins or ends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import MISALIGNED, MISTIMED, NONE
from impslam.types import Array, Ints, Mask

LAGS = 0.1 * np.arange(-5, 6)
"""s, lags of the scans that are compared; 0 is the one in the middle. Between matches the heading is
interpolated, so a lag is known to half the time between them."""
MIN_LAG = 0.2
"""s: a smaller lag is tolerated; at walking pace it displaces the robot by 20 cm."""
TURN_SIGMA = 0.005
"""rad: smallest error of a turn by scans."""
MIN_LAG_EVIDENCE = 50.0
"""Difference of the sums of squares that the correlations make, in variances of a turn between matches: a
turn at 0.5 rad/s shows 0.3 s with 130."""
MIN_LEFT_EVIDENCE = 20.0
"""Least difference of what is left of the squares of the turns."""
MIN_TURNS = 8.0
"""Turns that are compared: one lag always fits a few of them well by chance."""
TURN_MEMORY = 3.0
"""rad of turning over which lags are compared."""
MAX_INTERVAL = 0.6
"""s between two matches beyond which the turn in between is not known well enough."""
MIN_ROTATION = 0.05
"""rad: a smaller turn of the mount is tolerated; sideways motion is then within the drift of wheels."""
ROTATION_SIGMAS = 4.0
"""Standard deviations that it must exceed."""
SIDEWAYS_SIGMA = 0.003
"""m: smallest error of a sideways motion by scans."""
DISTANCE_MEMORY = 1.5
"""m of travel over which sideways motion is compared."""
MIN_DISTANCE = 0.7
"""m of travel that the comparison needs: less may be a single wrong match."""
MIN_STEPS = 6.0
"""Matches that the comparison needs for its standard deviation to mean something."""
MAX_SIDEWAYS = 0.3
"""Ratio of odometry's motion sideways and ahead beyond which it is not compared: the sideways scale of
omnidirectional wheels is off by up to 15 %, which would look like a turned mount."""
MAX_STEP = (0.5, 0.3)
"""m, rad of motion between two matches beyond which they are not compared."""
_CAPACITY = 64
"""Matches kept: more than those of a second, since a match follows 5 cm or 0.04 rad of motion."""


class Offsets(NamedTuple):
    """State of the check; the kernels change it in place.

    Attributes
    ----------
    history : (3, _CAPACITY) time in s, heading by odometry and by scans at the newest matches: a ring
    ring : (2,) number of matches added, and of those whose lags were compared
    products, squares : (lags,) sums of the products of turns by scans and by odometry at each lag, and of
        the squares of the latter, rad^2
    turns : (2,) number of the turns by scans, and the sum of their squares, rad^2
    sideways : (3, 3) sums of products of distance ahead and turn by odometry, and sideways difference
        between scans and odometry
    steps : (2,) number of the motions, and their distance in m
    newest : (2,) reason and amount of the newest result
    changed : (1,) whether the next match is of another lidar than the last one
    """

    history: Array
    ring: Ints
    products: Array
    squares: Array
    turns: Array
    sideways: Array
    steps: Array
    newest: Array
    changed: Mask


def initial_offsets() -> Offsets:
    """Return the state before the first match."""
    return Offsets(
        np.zeros((3, _CAPACITY)), np.zeros(2, np.int64), np.zeros(len(LAGS)),
        np.zeros(len(LAGS)), np.zeros(2), np.zeros((3, 3)), np.zeros(2), np.zeros(2),
        np.zeros(1, np.bool_),
    )  # fmt: skip


@kernel
def check_offsets(
    offsets: Offsets, odometry: Array, scans: Array, duration: float
) -> tuple[int, float]:
    """Update with the motions (3,) between two matches; return a reason and its amount.

    The reason is `MISALIGNED`, with degrees, `MISTIMED`, with s, or `NONE`. Motions between scans of two
    lidars contain the difference of their errors, which is sideways again and again at the same distances.
    """
    if duration > MAX_INTERVAL:
        interrupt(offsets)
    else:
        _add_turns(offsets, odometry[2], scans[2], duration)
    is_ahead = abs(odometry[1]) <= MAX_SIDEWAYS * abs(odometry[0]) and not offsets.changed[0]
    offsets.changed[0] = False
    if is_ahead and abs(scans[0]) < MAX_STEP[0] and abs(scans[2]) < MAX_STEP[1]:
        _add_sideways(offsets, odometry, scans)
    lag, rotation = _lag(offsets), _rotation(offsets)
    offsets.newest[0], offsets.newest[1] = NONE, 0.0
    if lag != 0.0:
        offsets.newest[0], offsets.newest[1] = MISTIMED, abs(lag)
    elif rotation != 0.0:
        offsets.newest[0], offsets.newest[1] = MISALIGNED, math.degrees(abs(rotation))
    return newest_offset(offsets)


@kernel
def newest_offset(offsets: Offsets) -> tuple[int, float]:
    """Return the newest reason and its amount."""
    return int(offsets.newest[0]), offsets.newest[1]


@kernel
def interrupt(offsets: Offsets) -> None:
    """Begin a new history, after a motion that cannot be compared."""
    offsets.ring[:] = 0


@kernel
def _add_turns(offsets: Offsets, odometry: float, scans: float, duration: float) -> None:
    """Add the turns of a match, and compare those that are old enough for all lags."""
    history, ring = offsets.history, offsets.ring
    new, last = ring[0] % _CAPACITY, (ring[0] - 1) % _CAPACITY
    if ring[0] == 0:
        history[:, new] = 0.0
    else:
        history[0, new] = history[0, last] + duration
        history[1, new] = history[1, last] + odometry
        history[2, new] = history[2, last] + scans
    ring[0] += 1
    first = max(ring[0] - _CAPACITY, 0)
    ring[1] = max(ring[1], first + 1)
    while ring[1] < ring[0] and history[0, ring[1] % _CAPACITY] <= history[0, new] - LAGS[-1]:
        j, i = ring[1] % _CAPACITY, (ring[1] - 1) % _CAPACITY
        ring[1] += 1
        if history[0, i] - LAGS[-1] < history[0, first % _CAPACITY]:
            continue
        turn = history[2, j] - history[2, i]
        keep = math.exp(-abs(turn) / TURN_MEMORY)
        offsets.turns[0] = keep * offsets.turns[0] + 1.0
        offsets.turns[1] = keep * offsets.turns[1] + turn**2
        for k in range(len(LAGS)):
            expected = _heading(history, first, ring[0], history[0, j] - LAGS[k])
            expected -= _heading(history, first, ring[0], history[0, i] - LAGS[k])
            offsets.products[k] = keep * offsets.products[k] + turn * expected
            offsets.squares[k] = keep * offsets.squares[k] + expected**2


@kernel
def _heading(history: Array, first: int, end: int, time: float) -> float:
    """Return the heading by odometry at a time within the history, rad."""
    low, high = first, end - 1
    while high - low > 1:
        middle = (low + high) // 2
        if history[0, middle % _CAPACITY] <= time:
            low = middle
        else:
            high = middle
    i, j = low % _CAPACITY, high % _CAPACITY
    step = history[0, j] - history[0, i]
    share = (time - history[0, i]) / step if step > 0.0 else 0.0
    return float(history[1, i] + share * (history[1, j] - history[1, i]))


@kernel
def _lag(offsets: Offsets) -> float:
    """Return the lag of the scans in s; 0 if a lag below `MIN_LAG` is possible."""
    products, left = offsets.products, np.empty(len(LAGS))
    best, tolerated, least = int(np.argmax(products)), -math.inf, math.inf
    for k in range(len(LAGS)):
        scale = max(products[k], 0.0) / max(offsets.squares[k], 1e-12)
        left[k] = offsets.turns[1] - scale * products[k]
        if abs(LAGS[k]) < MIN_LAG - 1e-9:
            tolerated, least = max(tolerated, products[k]), min(least, left[k])
    variance = max(left[best] / max(offsets.turns[0], 1.0), TURN_SIGMA**2)
    certain = offsets.turns[0] > MIN_TURNS
    certain = certain and 2.0 * (products[best] - tolerated) > MIN_LAG_EVIDENCE * variance
    certain = certain and least - left[best] > MIN_LEFT_EVIDENCE * variance
    return LAGS[best] if certain and 0 < best < len(LAGS) - 1 else 0.0


@kernel
def _add_sideways(offsets: Offsets, odometry: Array, scans: Array) -> None:
    """Add a motion between two matches.

    Distance and turn are those of odometry: errors of a match ahead and sideways are correlated, where a
    scan determines one direction better than another, and those of a robot that stands would add up to
    metres of travel sideways.
    """
    row = np.array([odometry[0], odometry[2], scans[1] - odometry[1]])
    keep = math.exp(-abs(odometry[0]) / DISTANCE_MEMORY)
    offsets.steps[0] = keep * offsets.steps[0] + 1.0
    offsets.steps[1] = keep * offsets.steps[1] + abs(odometry[0])
    for a in range(3):
        for b in range(3):
            offsets.sideways[a, b] = keep * offsets.sideways[a, b] + row[a] * row[b]


@kernel
def _rotation(offsets: Offsets) -> float:
    """Return by how much the mount has turned, rad; 0 if it is within `MIN_ROTATION` or not certain.

    The turns of the robot are a regressor as well: an axle that is not below the configured position, or a
    late clock, gives sideways motion in turns.
    """
    S = offsets.sideways
    det = S[0, 0] * S[1, 1] - S[0, 1] ** 2
    few = offsets.steps[0] < MIN_STEPS or offsets.steps[1] < MIN_DISTANCE
    if few or not det > 1e-9 * S[0, 0]:
        return 0.0
    slope = (S[1, 1] * S[0, 2] - S[0, 1] * S[1, 2]) / det
    by_turn = (S[0, 0] * S[1, 2] - S[0, 1] * S[0, 2]) / det
    left = S[2, 2] - slope * S[0, 2] - by_turn * S[1, 2]
    variance = max(left / max(offsets.steps[0] - 2.0, 1.0), SIDEWAYS_SIGMA**2) * S[1, 1] / det
    certain = abs(slope) > max(MIN_ROTATION, ROTATION_SIGMAS * math.sqrt(variance))
    return -math.asin(min(max(slope, -1.0), 1.0)) if certain else 0.0
