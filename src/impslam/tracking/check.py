"""Whether odometry tells of the motion that the scans show, and what stands in for it where it does not.

A wheel that slips, an encoder that freezes or falls silent: odometry then says little or nothing, and
says it with no covariance, for its noise grows with the way that it tells of. That an encoder stands is no
proof that the robot does. Here scans are matched to the last metres with a prior so wide that odometry
cannot bind it. Over a few seconds the two motions must agree: their difference d has the covariance S of
odometry and of matching, and d^T S^-1 d is chi-square distributed with three degrees of freedom
(Bar-Shalom et al. 2001, ch. 5.4). Only odometry that lacks motion, or tells of a turn that the scans do not
show, is tested; a robot that stands while its wheels turn is found by `standing`. Beyond the gate the
scans' motion replaces odometry's, from the beginning of those seconds on. A robot that stands is not
contradicted, so that its covariance does not grow. Trackers that match scans themselves have no use for
this.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.algebra import between, solve, turned
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.kernels import kernel
from impslam.health import NONE, OPPOSED, PUSHED, SLIPPED, Reasons
from impslam.tracking.doubt import opposed
from impslam.tracking.local_map import LocalMap, empty_map
from impslam.tracking.matching import UNSOLVED, Settings, match
from impslam.tracking.surfels import Surfels, thin
from impslam.types import Array, Ints, Mask

SECONDS = 3.0
"""s over which both motions are compared: a robot that creeps at 5 cm/s goes 15 cm, which is seen."""
MOST = 300
"""Scans that are compared at most, where a clock stands: those of a lidar of 100 Hz."""
GATE = 21.1
"""d^T S^-1 d that one comparison in 10 000 exceeds by chance (chi-square, three degrees of freedom)."""
RATES = np.array([1.0, 0.5, 1.0])
"""m, m, rad, all /sqrt(s): how far a robot may have gone along, across and about while odometry cannot be
believed: as far as one at walking pace whose speed changes each second."""
SPREAD = np.array([0.03, 0.03, 0.02])
"""m, m, rad: what matching may be off by between any two places: surfaces are rough, people walk, and
half a lidar's view of a few metres is turned by 3 cm."""
SHARE = 0.1
"""Of the way (m) and the turn (rad), what matching may be off by: new points are laid beside old ones by
the pose that they are to tell, and a corridor's walls are the same everywhere."""
LACKS = 0.7
"""Share of the motion shown below which odometry lacks some of it: a frozen wheel tells half of the way.
Odometry that tells more than happened, or another direction, is left to its own covariance: scans of
bushes, of people or of a long corridor can show anything, but seldom a way that was not gone."""
LEAST = (0.05, 0.1)
"""m, rad: what has to lack at least; matching is off by less (`SPREAD`, to three sigma)."""
STANDS = 0.3
"""Share of the way shown below which the wheels stand."""
SPIN = 0.3
"""rad within 3 s that odometry turns more or less than the scans show: one wheel that stands on a straight
drive of 4 cm/s, on a track of 0.4 m, tells so much. Scans show turns even along a bare corridor."""
STRIDE = np.array([0.25, 0.2, 0.2])
"""s, m, rad: a scan is matched when so much has gone by since the last that was. Both motions are compared
over 3 s, of which these are steps; a scan still overlaps the last one, and its points find their partners
though odometry stands. While odometry is contradicted each scan is matched, because each takes its motion
from there."""
MEMORY = 6.0
"""m of way after which points are forgotten."""
SETTINGS = Settings(
    sigma=0.02,
    reach=0.5,
    spacing=0.1,
    memory=MEMORY,
    iterations=15,
    min_share=0.5,
    drift=np.array([0.03, 0.02, 0.02, 0.04]),
)
"""How scans are matched: points 10 cm apart, half of which have to find a partner."""


class Checked(NamedTuple):
    """The motions to use, and how the scans contradict the odometry at each sweep (m,), if they do."""

    motions: Motions
    reasons: Reasons


class Places(NamedTuple):
    """Where each chain of motions was at the matched scans of the last seconds, in a ring.

    Attributes
    ----------
    time : (MOST,) s
    matched, odometry, used : (MOST, 3) as matched, by odometry, and as handed on
    spread : (MOST, 3, 3) covariance of odometry and of matching added up, along the axes of odometry's
        first place: along a corridor matching tells little
    ring : (2,) number of places forgotten, and of places that ever were
    """

    time: Array
    matched: Array
    odometry: Array
    used: Array
    spread: Array
    ring: Ints


class Pending(NamedTuple):
    """Odometry's motion since the last scan that was matched.

    Attributes
    ----------
    pose, covariance : (3,), (3, 3)
    clock : (2,) s, how long it took, and the newest stamp
    doubt : (1,) whether that scan contradicted odometry
    turns : (2,) see `doubt.opposed`
    """

    pose: Array
    covariance: Array
    clock: Array
    doubt: Mask
    turns: Array


class OdometryCheck:
    """Compares odometry with scans; the motion that it returns is odometry's while they agree.

    Where they do not, it is the scans'.
    """

    spacing = SETTINGS.spacing

    def __init__(self) -> None:
        matched, odometry, used = (np.zeros((MOST, 3)) for _ in range(3))
        spread, ring = np.zeros((MOST, 3, 3)), np.zeros(2, np.int64)
        self._places = Places(np.zeros(MOST), matched, odometry, used, spread, ring)
        self._pending = Pending(
            np.zeros(3), np.zeros((3, 3)), np.zeros(2), np.zeros(1, np.bool_), np.zeros(2)
        )
        self._known = empty_map()

    def check(self, motions: Motions, surfels: Surfels | None) -> Checked:
        """Return the motions to these sweeps as they are best taken; call it once for each sweep."""
        if surfels is None:
            return Checked(motions, np.zeros(len(motions.stamps), np.int8))
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        taken = motions._replace(d_pose=d_pose, covariance=covariance)
        return Checked(
            taken,
            _check(taken, surfels, self._known, SETTINGS, self._places, self._pending),
        )


@kernel
def _check(
    motions: Motions,
    surfels: Surfels,
    known: LocalMap,
    settings: Settings,
    places: Places,
    pending: Pending,
) -> Reasons:
    """Change in place the motions that the scans contradict; return how they do, (m,)."""
    stamps, d_pose, covariance, _ = motions
    out, before = np.zeros(len(d_pose), np.int8), np.empty(3)
    for k in range(len(d_pose)):
        # A clock may be set, back or ahead.
        elapsed = min(max(stamps[k] - pending.clock[1], 0.0), SECONDS) if places.ring[1] else 0.0
        pending.clock[0] += elapsed
        pending.clock[1] = stamps[k]
        before[:] = pending.pose
        advance(pending.pose, pending.covariance, d_pose[k], covariance[k])
        if not _due(places, pending):
            continue
        points = surfels.rows[surfels.starts[k] : surfels.starts[k + 1]]
        points = thin(points, settings.spacing, True)
        motion, wide = pending.pose.copy(), pending.covariance.copy()
        _widen(wide, pending.clock[0])
        if match(motion, wide, points, known, settings) != UNSOLVED:
            out[k] = _contradicted(before, motion, wide, places, pending)
            if out[k] != NONE:
                _instead(d_pose[k], covariance[k], before, motion, wide, places)
            if opposed(pending.turns, pending.pose[2], motion[2]):
                out[k] = OPPOSED
            advance_pose(places.used[(places.ring[1] - 1) % MOST], d_pose[k])
        pending.doubt[0] = out[k] != NONE
        pending.pose[:], pending.covariance[:], pending.clock[0] = 0.0, 0.0, 0.0
    return out


@kernel
def _due(places: Places, pending: Pending) -> bool:
    """Tell whether a scan is to be matched."""
    if places.ring[1] == 0 or pending.doubt[0]:
        return True
    way = math.hypot(pending.pose[0], pending.pose[1])
    late, far = pending.clock[0] >= STRIDE[0], way >= STRIDE[1]
    return bool(late or far or abs(pending.pose[2]) >= STRIDE[2])


@kernel
def _widen(covariance: Array, seconds: float) -> None:
    """Let nothing be believed of odometry for some time."""
    for a in range(3):
        covariance[a, a] += RATES[a] ** 2 * seconds


@kernel
def _contradicted(
    before: Array, matched: Array, spread: Array, places: Places, pending: Pending
) -> int:
    """Enter a scan that was matched; tell how it contradicts odometry, if it does.

    `before` is the pending motion without that of the newest sweep, `matched` all of it as the scans
    show it, with the covariance `spread`. Of `used` the newest motion is still to come.
    """
    last, new = (places.ring[1] - 1) % MOST, places.ring[1] % MOST
    places.ring[1] += 1
    if places.ring[1] == 1:
        return NONE  # the first place is the origin of all chains
    for chain, motion in (
        (places.matched, matched),
        (places.odometry, pending.pose),
        (places.used, before),
    ):
        chain[new] = chain[last]
        advance_pose(chain[new], motion)
    places.time[new] = places.time[last] + pending.clock[0]
    both = pending.covariance + spread
    places.spread[new] = places.spread[last] + turned(both, places.odometry[last, 2])
    places.ring[0] = max(places.ring[0], places.ring[1] - MOST)
    while (
        places.ring[1] - places.ring[0] > 2
        and places.time[(places.ring[0] + 1) % MOST] < places.time[new] - SECONDS
    ):
        places.ring[0] += 1
    first = places.ring[0] % MOST
    told, shown = np.empty(3), np.empty(3)
    between(places.odometry[first], places.odometry[new], told)
    between(places.matched[first], places.matched[new], shown)
    reason = _difference(told, shown)
    if reason == NONE or _distance2(places, told, shown) <= GATE:
        return NONE
    return reason


@kernel
def _difference(told: Array, shown: Array) -> int:
    """Return how the motion that odometry tells differs from that shown, unless it may just be noise.

    It lacks a good part of the way or of the turn, or it tells of a turn that is not shown.
    """
    way, seen = math.hypot(told[0], told[1]), math.hypot(shown[0], shown[1])
    if way < LACKS * seen - LEAST[0] or abs(told[2]) < LACKS * abs(shown[2]) - LEAST[1]:
        stands = way < STANDS * seen and abs(told[2]) < LEAST[1]
        return PUSHED if stands else SLIPPED
    return SLIPPED if abs(wrap_in_kernel(told[2] - shown[2])) >= SPIN else NONE


@kernel
def _distance2(places: Places, told: Array, shown: Array) -> float:
    """Return d^T S^-1 d of the two motions (3,) from the first place to the newest."""
    first, new, d = places.ring[0] % MOST, (places.ring[1] - 1) % MOST, np.empty(3)
    between(told, shown, d)
    S = turned(places.spread[new] - places.spread[first], -places.odometry[new, 2])
    way = max(abs(told[0]), abs(shown[0]), abs(told[1]), abs(shown[1]))
    turn = max(abs(told[2]), abs(shown[2]))
    # Odometry's heading was wrong all the way, at most: the way is its lever.
    by_heading = S[2, 2]
    S[0, 0] += SPREAD[0] ** 2 + (SHARE * way) ** 2 + told[1] ** 2 * by_heading
    S[1, 1] += SPREAD[1] ** 2 + (SHARE * way) ** 2 + told[0] ** 2 * by_heading
    S[2, 2] += SPREAD[2] ** 2 + (SHARE * turn) ** 2
    x = d.copy()
    if not solve(S, x):
        return 0.0
    return float(d[0] * x[0] + d[1] * x[1] + d[2] * x[2])


@kernel
def _instead(
    d_pose: Array,
    covariance: Array,
    before: Array,
    matched: Array,
    spread: Array,
    places: Places,
) -> None:
    """Put in place the motion that takes what was used so far to where matching is.

    What that makes good on top of the newest motion has perhaps been made good by landmarks before,
    so all of it is unsure.
    """
    first, new = places.ring[0] % MOST, (places.ring[1] - 1) % MOST
    shown, used, instead, late = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    between(places.matched[first], places.matched[new], shown)
    between(places.used[first], places.used[new], used)
    between(used, shown, instead)
    if before.any():
        between(d_pose, instead, late)
    else:
        between(matched, instead, late)
    way, turn = math.hypot(matched[0], matched[1]), abs(matched[2])
    off = SHARE**2 * MEMORY
    d_pose[:] = instead
    for a in range(3):
        for b in range(3):
            covariance[a, b] = spread[a, b] + late[a] * late[b]
        covariance[a, a] += off * (turn if a == 2 else way)
