"""What a match says of health: whether the scan shows the map, and whether wheels and scans agree.

A scan of the place that the map shows fits about as well as those before it. Of a robot that was carried
elsewhere nearly all first scans fit less than `FITS` as well, and of one that was not about one in an
hour. Such a scan changes nothing: no map, no mean, nothing learned of odometry, and the pose follows
odometry. If the next ones do not fit either, the robot is elsewhere, and its maps begin anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.health import ELSEWHERE, NONE, OPEN, OPPOSED, PUSHED, SLIPPED, STALLED, UNEXPLAINED
from impslam.types import Array

FITS = 0.55
"""Share of the mean inlier share below which a scan shows another place."""
KNOWN = 0.7
"""Mean inlier share, of many scans and of the last few, above which one that does not fit says so: among
bushes, people and ramps many do not. Indoors the mean is 0.75 to 0.95, outdoors 0.4 to 0.65."""
FEWEST = 50
"""Points of a scan that can say so at least: half of fewer may fall on one chair."""
SIGMAS = 3.0
"""Standard deviations below the mean inlier share, at least: bushes and people fit by chance."""
AGAIN = 0.7, 0.9
"""Shares of the mean inlier share above which a scan shows the map again: where odometry has it, and
elsewhere, since places are alike."""
NEAR = 0.15, 0.1
"""m, rad: a match is where odometry has it within the scatter of a few matches."""
PERSISTS = 3, 0.4
"""Scans and s after which it is another place: what people hide one after another fits in between."""
MEMORY = 0.02, 0.05
"""Weights of the newest scan in the mean of many scans and in the variance: 50 scans, the kind of place;
20 scans, one view."""
INDOORS = 0.8, 0.08
"""Mean and standard deviation of the inlier share before the first scan."""
SECONDS = 1.0
"""s over which odometry and scans are compared: a few scans, and half a metre at walking pace."""
LACKS = 0.3
"""Share of the motion that one tells below which the other one stands."""
LEAST = 0.15, 0.25
"""m, rad: motion that is told within those seconds at least; matches are off by less."""
TURNING = 3.0
"""rad of turning that are remembered, to tell whether odometry and scans turn alike."""
TURNED = 0.05
"""rad^2, the products of both turns that have to add up at least: 0.5 rad in steps of 0.1."""
BARE = 1.0
"""m of way along a bare corridor that are told of: shorter, odometry is off by no more than a match."""


class Doubt(NamedTuple):
    """What the newest scans said; kernels change all of it in place.

    Attributes
    ----------
    poor : (2,) scans in a row that do not fit, and s since the first of them
    shares : (2,) mean of the inlier share of many scans, and its variance
    told, shown : (2,) m and rad that odometry told and that the scans showed within `SECONDS`
    bare : (1,) m of way since a scan told where the robot is
    turns : (2,) sums of the products of told and shown turns, and of their amounts, rad^2
    newest : (2,) reason and way of the newest match that was compared
    """

    poor: Array
    shares: Array
    told: Array
    shown: Array
    bare: Array
    turns: Array
    newest: Array


class Fit(NamedTuple):
    """How a scan fits the map.

    Attributes
    ----------
    points : number of points that are compared
    share : inlier share of them
    off : (3,) pose where it fits best, from where odometry has it
    """

    points: float
    share: float
    off: Array


def no_doubt() -> Doubt:
    """Return what is assumed before the first scan."""
    return Doubt(
        np.zeros(2),
        np.array([INDOORS[0], INDOORS[1] ** 2]),
        np.zeros(2),
        np.zeros(2),
        np.zeros(1),
        np.zeros(2),
        np.zeros(2),
    )


@kernel
def judge(doubt: Doubt, fit: Fit, usual: float, duration: float) -> int:
    """Tell whether a scan shows the map: `NONE` if it does, else `UNEXPLAINED` or `ELSEWHERE`.

    `usual` is the mean share before, `duration` s since the last scan.
    """
    share, off, shares = fit.share, usual - fit.share, doubt.shares
    if doubt.poor[0] > 0.0:
        moved = math.hypot(fit.off[0], fit.off[1]) > NEAR[0] or abs(fit.off[2]) > NEAR[1]
        fits = share >= usual * (AGAIN[1] if moved else AGAIN[0])
    else:
        fits = share >= usual * FITS or off < SIGMAS * math.sqrt(shares[1])
    if fits or fit.points < FEWEST or min(shares[0], usual) < KNOWN:
        shares[0] += MEMORY[0] * (share - shares[0])
        shares[1] += MEMORY[1] * (off * off - shares[1])
        doubt.poor[:] = 0.0
        return NONE
    doubt.poor[1] += duration if doubt.poor[0] > 0.0 else 0.0
    doubt.poor[0] += 1.0
    if doubt.poor[0] < PERSISTS[0] or doubt.poor[1] < PERSISTS[1]:
        return UNEXPLAINED
    doubt.poor[:] = 0.0
    return ELSEWHERE


@kernel
def compare(
    doubt: Doubt, told: Array, shown: Array, located: bool, far: bool, duration: float
) -> tuple[int, float]:
    """Take in a match; return a reason and the way in m that comes with it.

    `told` and `shown` are the motions (3,) since the last match by odometry and by the scans, `located`
    whether the scan tells where the robot is, and `far` whether it is far from where odometry has it.
    """
    keep = math.exp(-duration / SECONDS)
    for sums, motion in ((doubt.told, told), (doubt.shown, shown)):
        sums[0] = keep * sums[0] + math.hypot(motion[0], motion[1])
        sums[1] = keep * sums[1] + abs(motion[2])
    doubt.bare[0] = 0.0 if located else doubt.bare[0] + math.hypot(shown[0], shown[1])
    doubt.newest[0], doubt.newest[1] = _difference(doubt, located, far)
    if opposed(doubt.turns, told[2], shown[2]):
        doubt.newest[0], doubt.newest[1] = float(OPPOSED), 0.0
    return lasting(doubt, 0.0)


@kernel
def opposed(turns: Array, told: float, shown: float) -> bool:
    """Take in a turn as odometry tells it and as scans show it; tell whether they have opposite signs.

    They have where the products of both add up to less than minus half of their amounts: noise gives
    sums of any sign, but small ones.
    """
    keep = math.exp(-0.5 * (abs(told) + abs(shown)) / TURNING)
    turns[0] = keep * turns[0] + told * shown
    turns[1] = keep * turns[1] + abs(told * shown)
    return bool(turns[1] > TURNED and turns[0] < -0.5 * turns[1])


@kernel
def lasting(doubt: Doubt, duration: float) -> tuple[int, float]:
    """Return reason and way of the newest match for a scan that was not matched, so many s after it."""
    if duration > SECONDS:
        return NONE, 0.0
    return int(doubt.newest[0]), doubt.newest[1]


@kernel
def _difference(doubt: Doubt, located: bool, far: bool) -> tuple[float, float]:
    """Return why the newest match is no better than odometry, or odometry than the match, and a way."""
    if located:
        for a in range(2):
            if doubt.told[a] > LEAST[a] and doubt.shown[a] < LACKS * doubt.told[a]:
                return float(STALLED), 0.0
            if doubt.shown[a] > LEAST[a] and doubt.told[a] < LACKS * doubt.shown[a]:
                return float(PUSHED), 0.0
    if far:
        return float(SLIPPED), 0.0
    if doubt.bare[0] > BARE:
        return float(OPEN), doubt.bare[0]
    return float(NONE), 0.0
