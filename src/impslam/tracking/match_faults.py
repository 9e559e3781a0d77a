"""Detect faults from matches: whether the scan fits the map, and whether wheels and scans agree.

A scan of a place in the map fits about as well as those before it. After a kidnapping nearly all first
scans fit less than `MIN_FIT` as well, and contradict the map; otherwise about one scan in an hour does.
Such a scan changes nothing: no map, no mean, nothing learned about odometry, and the pose follows
odometry. If the next scans do not fit either, the robot is elsewhere, and new maps begin. A scan that
fits poorly without contradicting the map shows what the map does not contain yet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import ELSEWHERE, NONE, OPEN, OPPOSED, PUSHED, SLIPPED, STALLED, UNEXPLAINED
from impslam.tracking.offsets import (
    Offsets,
    check_offsets,
    initial_offsets,
    interrupt,
    newest_offset,
)
from impslam.types import Array

MIN_FIT = 0.55
"""Share of the mean inlier share below which a scan shows another place."""
MIN_USUAL_SHARE = 0.7
"""Mean inlier share, of many scans and of the last few, below which a poor fit means nothing: among bushes,
people and ramps many scans fit poorly. Indoors the mean is 0.75 to 0.95, outdoors 0.4 to 0.65."""
MIN_POINTS = 50
"""Points below which a poor fit means nothing: half of fewer may fall on one chair."""
SIGMAS = 3.0
"""Standard deviations below the mean inlier share that a poor fit has at least: bushes and people fit by
chance."""
RECOVERY_FIT = 0.7, 0.9
"""Shares of the mean inlier share above which a scan fits the map again: at the pose of odometry, and
elsewhere, since places look alike."""
NEAR_ODOMETRY = 0.15, 0.1
"""m, rad: a match is at the pose of odometry within this scatter of a few matches."""
MIN_POOR_SCANS, MAX_POOR_SCANS = (3, 0.4), 20
"""Scans and s of poor fit that mean another place, since scans that people occlude one after another fit in
between; and scans that do so in any case, because the stamps of some logs stand still."""
MAX_SPEED = 5.0
"""m/s: a distance takes at least the time at this speed, also where stamps stand still. Robots in buildings
are slower."""
MEMORY = 0.02, 0.05
"""Weights of the newest scan in the mean of many scans and in the variance: 50 scans, the kind of place;
20 scans, one view."""
INITIAL_SHARE = 0.8, 0.08
"""Mean and standard deviation of the inlier share before the first scan."""
WINDOW = 1.0
"""s over which odometry and scans are compared: a few scans, half a metre at walking pace."""
STATIONARY_SHARE = 0.3
"""Share of the motion reported by one source; if the other reports less, it shows a stationary robot."""
MIN_MOTION = 0.15, 0.25
"""m, rad: motion within this window below which nothing is compared; errors of matches are smaller."""
LONG_WINDOW = 3.0
"""s over which distances by odometry and by scans are compared: a metre or two."""
MIN_DISTANCE, MAX_DIFFERENCE = 0.5, 0.25
"""m, and share of the distance by which the two may differ. Odometry is off by 10 % at most, and errors of
matches, by 5 cm; five recorded logs have 15 % at most."""
MAX_STEP = 0.1
"""m of difference that one match adds to that of the distances: a larger one is a slip, and passes."""
TURN_MEMORY = 3.0
"""rad of turning over which the signs of turns by odometry and by scans are compared."""
MIN_TURN_PRODUCT = 0.05
"""rad^2: smallest sum of the products of both turns that is tested: 0.5 rad in steps of 0.1."""
MIN_OPEN_DISTANCE = 1.0
"""m along a bare corridor that are reported; over less, odometry is off by no more than a match."""
MIN_DISPUTED = 0.05, 0.15
"""m, and share of the distance, that scans show less than odometry in a disagreement."""
MAX_OPPOSITE = 0.5
"""Share of odometry's motion that scans may show the other way: people seldom walk so much faster."""
UNDISPUTED = 1e-6
"""m disputed after a motion the other way: the window contains that motion, so only later ones count."""
DISPUTED_VARIANCE = 0.5
"""Variance of the distance, as a share of the square of what scans show less than odometry: people who walk
along with the robot look like slipping wheels, and at even odds either is right."""


class MatchFaults(NamedTuple):
    """State of the checks over the newest scans; kernels change all of it in place.

    Attributes
    ----------
    poor : (2,) scans in a row that do not fit, and s since the first of them, or more if the robot has gone
        farther than it can in that time
    shares : (2,) mean of the inlier share of many scans, and its variance
    odometry, scans : (6,) by odometry and by the scans: m travelled and rad turned either way within
        `WINDOW`, m forward within `LONG_WINDOW`, and rad turned to the left, m forward and m to the left
        within `WINDOW`
    unlocated : (1,) m travelled since a scan last determined the position
    turns : (2,) sums of the products of turns by odometry and by scans, and of their magnitudes, rad^2
    disputed : (1,) m that scans have shown less than odometry since the two disagree
    newest : (2,) reason and distance of the newest match that was compared
    offsets : of the lidar's mount and clock
    """

    poor: Array
    shares: Array
    odometry: Array
    scans: Array
    unlocated: Array
    turns: Array
    disputed: Array
    newest: Array
    offsets: Offsets


class MatchQuality(NamedTuple):
    """How a scan fits the map.

    Attributes
    ----------
    points : number of compared points
    share : inlier share of them
    off : (3,) best-fitting pose, relative to that of odometry
    """

    points: float
    share: float
    off: Array


def initial_faults() -> MatchFaults:
    """Return the state before the first scan."""
    return MatchFaults(
        np.zeros(2),
        np.array([INITIAL_SHARE[0], INITIAL_SHARE[1] ** 2]),
        np.zeros(6),
        np.zeros(6),
        np.zeros(1),
        np.zeros(2),
        np.zeros(1),
        np.zeros(2),
        initial_offsets(),
    )


@kernel
def fits_poorly(faults: MatchFaults, fit: MatchQuality, usual: float) -> bool:
    """Return whether a scan fits much worse than those before it; `usual` is the mean share so far."""
    if fit.points < MIN_POINTS or min(faults.shares[0], usual) < MIN_USUAL_SHARE:
        return False
    if faults.poor[0] > 0.0:
        moved = (
            math.hypot(fit.off[0], fit.off[1]) > NEAR_ODOMETRY[0]
            or abs(fit.off[2]) > NEAR_ODOMETRY[1]
        )
        return bool(fit.share < usual * (RECOVERY_FIT[1] if moved else RECOVERY_FIT[0]))
    unlikely = usual - fit.share >= SIGMAS * math.sqrt(faults.shares[1])
    return bool(unlikely and fit.share < usual * MIN_FIT)


@kernel
def add_fit(faults: MatchFaults, fit: MatchQuality, usual: float) -> None:
    """Update with a scan that fits the map."""
    off, shares = usual - fit.share, faults.shares
    shares[0] += MEMORY[0] * (fit.share - shares[0])
    shares[1] += MEMORY[1] * (off * off - shares[1])
    faults.poor[:] = 0.0


@kernel
def add_misfit(faults: MatchFaults, duration: float, distance: float) -> int:
    """Update with a scan that does not fit; return the reason.

    It comes `duration` s and `distance` m after the last one.
    """
    faults.poor[1] += max(duration, distance / MAX_SPEED) if faults.poor[0] > 0.0 else 0.0
    faults.poor[0] += 1.0
    few = faults.poor[0] < MIN_POOR_SCANS[0] or faults.poor[1] < MIN_POOR_SCANS[1]
    if few and faults.poor[0] < MAX_POOR_SCANS:
        return UNEXPLAINED
    faults.poor[:] = 0.0
    return ELSEWHERE


@kernel
def check_motion(
    faults: MatchFaults, odometry: Array, scans: Array, located: bool, far: bool, duration: float
) -> tuple[int, float]:
    """Update with a match; return a reason and the amount that comes with it.

    `odometry` and `scans` are the motions (3,) since the last match, `located` is whether the scan
    determines the position, and `far` whether the match is far from the pose of odometry.
    """
    keep = math.exp(-duration / WINDOW)
    for sums, motion in ((faults.odometry, odometry), (faults.scans, scans)):
        sums[0] = keep * sums[0] + math.hypot(motion[0], motion[1])
        sums[1] = keep * sums[1] + abs(motion[2])
        sums[2] *= math.exp(-duration / LONG_WINDOW)
        sums[3] = keep * sums[3] + motion[2]
        sums[4] = keep * sums[4] + motion[0]
        sums[5] = keep * sums[5] + motion[1]
    faults.odometry[2] += odometry[0]
    difference = min(max(scans[0] - odometry[0], -MAX_STEP), MAX_STEP)
    faults.scans[2] += odometry[0] + difference
    faults.unlocated[0] = 0.0 if located else faults.unlocated[0] + math.hypot(scans[0], scans[1])
    faults.newest[0], faults.newest[1] = _motion_fault(faults, located, far)
    if turns_oppose(faults.turns, odometry[2], scans[2]):
        faults.newest[0], faults.newest[1] = float(OPPOSED), 0.0
    if is_odometry_wrong(faults):
        interrupt(faults.offsets)
    else:
        check_offsets(faults.offsets, odometry, scans, duration)
    return current_fault(faults, 0.0)


@kernel
def disputed_variance(faults: MatchFaults, odometry: Array, scans: Array) -> float:
    """Update after `check_motion`; return the variance in m^2 that a disputed distance adds to this match.

    `odometry` and `scans` are the motions (3,) since the last match. The errors of all matches in a
    disagreement have one cause, so their sum has the variance of the whole difference.
    """
    before = faults.disputed[0]
    ahead, missing = faults.odometry[2], faults.odometry[2] - faults.scans[2]
    opposite = scans[0] * odometry[0] < 0.0 and abs(scans[0]) > MAX_OPPOSITE * abs(odometry[0])
    small = abs(missing) < MIN_DISPUTED[0] + MIN_DISPUTED[1] * abs(ahead)
    if opposite or missing * ahead < 0.0 or small:
        faults.disputed[0] = UNDISPUTED if opposite else 0.0
        return 0.0
    if before > 0.0:  # else it began within the window
        missing = odometry[0] - scans[0]
    after = max(before, before + math.copysign(missing, missing * ahead))
    faults.disputed[0] = after
    return float(DISPUTED_VARIANCE * (after * after - before * before))


@kernel
def turns_oppose(turns: Array, odometry: float, scans: float) -> bool:
    """Update with a turn by odometry and by scans; return whether the two have opposite signs.

    They do if their products add up to less than minus half of the magnitudes: noise gives sums of
    either sign, but small ones.
    """
    keep = math.exp(-0.5 * (abs(odometry) + abs(scans)) / TURN_MEMORY)
    turns[0] = keep * turns[0] + odometry * scans
    turns[1] = keep * turns[1] + abs(odometry * scans)
    return bool(turns[1] > MIN_TURN_PRODUCT and turns[0] < -0.5 * turns[1])


@kernel
def is_slipping(faults: MatchFaults) -> bool:
    """Return whether wheels slip: by the newest matches, the robot moves otherwise than by odometry."""
    return int(faults.newest[0]) == SLIPPED


@kernel
def is_odometry_wrong(faults: MatchFaults) -> bool:
    """Return whether the newest match disagrees with odometry."""
    return int(faults.newest[0]) not in (NONE, OPEN)


@kernel
def current_fault(faults: MatchFaults, duration: float) -> tuple[int, float]:
    """Return the newest match's reason and amount for an unmatched scan `duration` s after it."""
    if duration > WINDOW or faults.newest[0] == NONE:
        return newest_offset(faults.offsets)
    return int(faults.newest[0]), faults.newest[1]


@kernel
def _stands(one: Array, other: Array) -> bool:
    """Return whether one source of the sums (6,) shows a stationary robot, and the other one does not."""
    net, other_net = math.hypot(one[4], one[5]), math.hypot(other[4], other[5])
    return _is_small(one[0], net, other[0], other_net, MIN_MOTION[0]) or _is_small(
        one[1], abs(one[3]), other[1], abs(other[3]), MIN_MOTION[1]
    )


@kernel
def _is_small(way: float, net: float, other_way: float, other_net: float, least: float) -> bool:
    """Return whether one motion is that of a stationary robot, and the other one is more than `least`.

    They must differ in the way and in the net motion: errors add up in the former alone, as those of the
    wheels, or of the matches of two lidars in turn, and motions to and fro cancel in the latter.
    """
    small = way < STATIONARY_SHARE * other_way and net < STATIONARY_SHARE * other_net
    return bool(small and min(other_way, other_net) > least)


@kernel
def _motion_fault(faults: MatchFaults, located: bool, far: bool) -> tuple[float, float]:
    """Return the disagreement between the newest match and odometry, and a distance in m."""
    odometry, scans = faults.odometry, faults.scans
    turns = odometry[1] > MIN_MOTION[1]  # then a lidar that is not at its mount moves, too
    if located:
        if _stands(scans, odometry):
            return float(STALLED), 0.0
        if not turns and _stands(odometry, scans):
            return float(PUSHED), 0.0
    ahead, by_scans = faults.odometry[2], faults.scans[2]
    distance = max(abs(ahead), abs(by_scans))
    differs = distance > MIN_DISTANCE and abs(by_scans - ahead) > MAX_DIFFERENCE * distance
    if far or differs:
        return float(SLIPPED), 0.0
    if faults.unlocated[0] > MIN_OPEN_DISTANCE:
        return float(OPEN), faults.unlocated[0]
    return float(NONE), 0.0
