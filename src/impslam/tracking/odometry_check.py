"""Check odometry against scan matching, and replace it if the two disagree.

If a wheel slips, or an encoder freezes or goes silent, odometry reports little or no motion, with almost no
covariance, because its noise grows with the reported distance. Here scans are matched with submaps, with
a prior too wide for odometry to constrain the result. Over a few seconds the two motions must agree: their
difference d has the covariance S of odometry and of matching together, and d^T S^-1 d is chi-square
distributed with three degrees of freedom (Bar-Shalom et al. 2001, ch. 5.4). Only odometry that misses
motion, or reports a turn that the scans do not show, is tested; a robot that is stationary while its wheels
turn is detected by `stall`. Beyond the gate, the motion from the scans replaces odometry from the beginning
of that window on. A stationary robot is not contradicted, so its covariance does not grow.
Trackers that match scans do not need this check.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.algebra import between, invert, rotate_covariance, solve
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.chi_square import GATE_3D_9999
from impslam.geometry.kernels import kernel
from impslam.health import NONE, OPPOSED, PUSHED, SLIPPED, Reasons
from impslam.surfaces.features import Features, leave_out_oblique
from impslam.surfaces.surface_map import Alignment, align, no_evidence
from impslam.tracking.beams import BeamColumns, find_beam_features
from impslam.tracking.match_faults import INITIAL_SHARE, STATIONARY_SHARE, turns_oppose
from impslam.tracking.match_information import add_drift, remove_spurious
from impslam.tracking.offsets import (
    Offsets,
    check_offsets,
    initial_offsets,
    interrupt,
    newest_offset,
)
from impslam.tracking.submaps import Submaps, empty_submaps, extend, is_empty, older_map
from impslam.types import Array, Ints, Mask

WINDOW = 3.0
"""s over which both motions are compared: at 5 cm/s the robot moves 15 cm, which scans show."""
MAX_SCANS = 300
"""Scans in the window, a bound for clocks that stand still: those of a lidar of 100 Hz."""
GATE = GATE_3D_9999
"""d^T S^-1 d that one comparison in 10 000 exceeds by chance."""
UNKNOWN_MOTION_SIGMA = np.array([1.0, 0.5, 1.0])
"""m, m, rad, all /sqrt(s): motion forward, sideways and in heading while odometry cannot be trusted: that
of a robot at walking pace whose speed changes each second."""
MATCH_SIGMA = np.array([0.03, 0.03, 0.02])
"""m, m, rad: error of matching between any two poses: surfaces are rough, people walk, and 3 cm turn half
a lidar's view of a few metres by that angle."""
MATCH_ERROR_SHARE = 0.1
"""Error of matching as a share of distance and turn: new points enter the map at the pose estimated from
them, and a corridor's walls look the same everywhere."""
MIN_REPORTED = 0.7
"""Share of the matched motion that odometry must report; with one frozen wheel it reports half. Odometry
that reports too much, or another direction, is left to its own covariance: scans of bushes, people or a
long corridor can show any motion, but seldom one that did not happen."""
MIN_MISSING = (0.05, 0.1)
"""m, rad: motion that must be missing at least; errors of matching are smaller (three `MATCH_SIGMA`)."""
MAX_TURN_DIFFERENCE = 0.3
"""rad within 3 s between the turns by odometry and by scans: one frozen wheel on a straight drive at 4
cm/s, with a track of 0.4 m, causes this much. Scans show turns even along a bare corridor."""
MATCH_INTERVAL = np.array([0.25, 0.2, 0.2])
"""s, m, rad: a scan is matched after this much since the last match. These are steps of the window of 3 s;
a scan still overlaps the last one, so that its points find their partners even if odometry is frozen. While
odometry is contradicted each scan is matched, because matching gives its motion."""
LENGTH, REACH = 12.0, 50.0
"""m that a submap lasts for, and range of the points in it; as in `ScanToMap`."""
MIN_POINTS, SPACING = 10, 0.1
"""Points that matching needs, and m between them: a check needs fewer than `ScanToMap`."""
MIN_SHARE, MIN_FIT = 0.5, 0.8
"""Share of the points that must fit the submap, and the same relative to the usual share: three walls of
four, 0.75, may fit elsewhere, and people cover less than a fifth of most scans."""
SHARE_MEMORY = 0.1
"""Weight of the newest scan in the usual share: ten scans, a few metres."""
MATCHING = Alignment(14, 0.4, 0.06, 0.035**-2, 1, math.inf)
"""Settings of `ScanToMap`, and a prior without heavy tails."""
DRIFT = np.array([0.03, 0.02, 0.02, 0.04])
"""m/sqrt(m) along and across the path, rad/sqrt(m), rad/sqrt(rad): drift of matched motion."""


class CheckedMotions(NamedTuple):
    """The motions to use, and for each sweep (m,) how the scans contradict odometry, if they do."""

    motions: Motions
    reasons: Reasons
    amounts: Array


class MatchHistory(NamedTuple):
    """Poses of each chain of motions at the scans matched in the window: a ring buffer.

    Attributes
    ----------
    time : (MAX_SCANS,) s
    matched, odometry, used : (MAX_SCANS, 3) as matched, by odometry, and as handed on
    spread : (MAX_SCANS, 3, 3) cumulative covariance of odometry and of matching, in the frame of odometry's
        first pose: along a corridor matching determines little
    ring : (2,) number of poses dropped, and of poses added so far
    """

    time: Array
    matched: Array
    odometry: Array
    used: Array
    spread: Array
    ring: Ints


class PendingMotion(NamedTuple):
    """Odometry's motion since the last scan that was matched.

    Attributes
    ----------
    pose, covariance : (3,), (3, 3)
    clock : (2,) s, its duration, and the newest stamp
    contradicted : (1,) whether that scan contradicted odometry
    turns : (2,) see `match_faults.turns_oppose`
    offsets : of the lidar's mount and clock
    place : (3,) pose of that scan in the frame of the submaps
    usual : (1,) mean share of the points that fit the submap
    """

    pose: Array
    covariance: Array
    clock: Array
    contradicted: Mask
    turns: Array
    offsets: Offsets
    place: Array
    usual: Array


class OdometryCheck:
    """Compares odometry with scans, and returns the motion from the scans if they disagree."""

    def __init__(self) -> None:
        matched, odometry, used = (np.zeros((MAX_SCANS, 3)) for _ in range(3))
        spread, ring = np.zeros((MAX_SCANS, 3, 3)), np.zeros(2, np.int64)
        self._places = MatchHistory(np.zeros(MAX_SCANS), matched, odometry, used, spread, ring)
        self._pending = PendingMotion(
            np.zeros(3), np.zeros((3, 3)), np.zeros(2), np.zeros(1, np.bool_), np.zeros(2),
            initial_offsets(), np.zeros(3), np.full(1, INITIAL_SHARE[0]),
        )  # fmt: skip
        self._submaps = empty_submaps(REACH + LENGTH)

    def check(self, motions: Motions, beams: BeamColumns) -> CheckedMotions:
        """Return the motions to use for these sweeps; call it once for each sweep."""
        amounts = np.zeros(len(motions.stamps))
        if not beams.points.shape[1]:
            return CheckedMotions(motions, np.zeros(len(amounts), np.int8), amounts)
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        taken = motions._replace(d_pose=d_pose, covariance=covariance)
        reasons = _check(
            taken, beams, self._submaps, MATCHING, self._places, self._pending, amounts
        )
        return CheckedMotions(taken, reasons, amounts)


@kernel
def _check(
    motions: Motions,
    beams: BeamColumns,
    submaps: Submaps,
    matching: Alignment,
    history: MatchHistory,
    pending: PendingMotion,
    amounts: Array,
) -> Reasons:
    """Replace, in place, the motions that the scans contradict; return the reasons (m,), fill amounts."""
    stamps, d_pose, covariance, _ = motions
    out, before = np.zeros(len(d_pose), np.int8), np.empty(3)
    features = np.empty((beams.points.shape[1], 5), np.float32)
    for k in range(len(d_pose)):
        # The clock may be set back or ahead.
        elapsed = min(max(stamps[k] - pending.clock[1], 0.0), WINDOW) if history.ring[1] else 0.0
        pending.clock[0] += elapsed
        pending.clock[1] = stamps[k]
        before[:] = pending.pose
        advance(pending.pose, pending.covariance, d_pose[k], covariance[k])
        if not _due(history, pending):
            out[k], amounts[k] = newest_offset(pending.offsets)
            continue
        surfaces = _find_surfaces(beams, k, features)
        (motion, wide), by_scans = _predict(pending), pending.contradicted[0]
        if _match(motion, wide, surfaces, pending, submaps, matching):
            out[k] = _find_contradiction(before, motion, wide, history, pending)
            by_scans |= out[k] != NONE
            if by_scans:
                _substitute(d_pose[k], covariance[k], before, motion, wide, history)
            if turns_oppose(pending.turns, pending.pose[2], motion[2]):
                out[k] = OPPOSED
            advance_pose(history.used[(history.ring[1] - 1) % MAX_SCANS], d_pose[k])
        pending.contradicted[0] = out[k] != NONE
        if by_scans:
            interrupt(pending.offsets)
        else:
            out[k], amounts[k] = check_offsets(
                pending.offsets, pending.pose, motion, pending.clock[0]
            )
        pending.pose[:], pending.covariance[:], pending.clock[0] = 0.0, 0.0, 0.0
    return out


@kernel
def _find_surfaces(beams: BeamColumns, k: int, features: Features) -> Features:
    """Return the features of sweep k, without oblique surfaces; they are stored in `features`."""
    count = find_beam_features(beams, k, SPACING, False, features)
    return features[: leave_out_oblique(features[:count])]


@kernel
def _due(history: MatchHistory, pending: PendingMotion) -> bool:
    """Return whether the scan should be matched."""
    if history.ring[1] == 0 or pending.contradicted[0]:
        return True
    distance = math.hypot(pending.pose[0], pending.pose[1])
    late, far = pending.clock[0] >= MATCH_INTERVAL[0], distance >= MATCH_INTERVAL[1]
    return bool(late or far or abs(pending.pose[2]) >= MATCH_INTERVAL[2])


@kernel
def _predict(pending: PendingMotion) -> tuple[Array, Array]:
    """Return the motion (3,), (3, 3) since the last scan if odometry is not trusted.

    Odometry that was silent reports what it missed at once, although the scans have given the motion.
    """
    motion, covariance = pending.pose.copy(), pending.covariance.copy()
    unknown = UNKNOWN_MOTION_SIGMA**2 * pending.clock[0]
    if pending.contradicted[0] and covariance[0, 0] + covariance[1, 1] > unknown[0] + unknown[1]:
        motion[:], covariance[:] = 0.0, 0.0
    for a in range(3):
        covariance[a, a] += unknown[a]
    return motion, covariance


@kernel
def _match(
    motion: Array,
    covariance: Array,
    features: Features,
    pending: PendingMotion,
    submaps: Submaps,
    matching: Alignment,
) -> bool:
    """Refine, in place, the motion (3,), (3, 3) since the last scan; add the scan to the submaps.

    It stays that of odometry, with its covariance, if too few points fit. Returns whether odometry and scan
    have a solution; without one nothing changes.
    """
    place = pending.place
    can_match = len(features) >= MIN_POINTS and not is_empty(submaps)
    if can_match and not _refine(motion, covariance, features, pending, submaps, matching):
        return False
    advance_pose(place, motion)
    submaps.travelled[0] += math.hypot(motion[0], motion[1])
    extend(submaps, features, place, LENGTH)
    return True


@kernel
def _refine(
    motion: Array,
    covariance: Array,
    features: Features,
    pending: PendingMotion,
    submaps: Submaps,
    matching: Alignment,
) -> bool:
    """Refine the motion if enough points fit the submap; return whether there is a solution."""
    place, usual = pending.place, pending.usual[0]
    pose, prior = place.copy(), rotate_covariance(covariance, place[2])
    advance_pose(pose, motion)
    if not invert(prior):
        return False
    weights, evidence = np.array([prior[0, 0], prior[1, 1], prior[2, 2]]), no_evidence()
    share = align(older_map(submaps), features, pose, weights, matching, evidence)
    pending.usual[0] += SHARE_MEMORY * (share - usual)
    if share < max(MIN_SHARE, MIN_FIT * usual):
        return True
    information = matching.information * evidence.H
    remove_spurious(information)
    information += prior
    if not (np.isfinite(pose).all() and invert(information)):
        return False
    between(place, pose, motion)
    covariance[:] = rotate_covariance(information, -place[2])
    add_drift(motion, DRIFT, covariance)
    return True


@kernel
def _find_contradiction(
    before: Array, matched: Array, spread: Array, history: MatchHistory, pending: PendingMotion
) -> int:
    """Add a matched scan to the history; return how it contradicts odometry, or `NONE`.

    `before` is the pending motion without that of the newest sweep; `matched` is all of it by the scans,
    with covariance `spread`. The newest motion of `used` is added later.
    """
    last, new = (history.ring[1] - 1) % MAX_SCANS, history.ring[1] % MAX_SCANS
    history.ring[1] += 1
    if history.ring[1] == 1:
        return NONE  # the first pose is the origin of all chains
    for chain, motion in (
        (history.matched, matched),
        (history.odometry, pending.pose),
        (history.used, before),
    ):
        chain[new] = chain[last]
        advance_pose(chain[new], motion)
    history.time[new] = history.time[last] + pending.clock[0]
    total = pending.covariance + spread
    history.spread[new] = history.spread[last] + rotate_covariance(total, history.odometry[last, 2])
    history.ring[0] = max(history.ring[0], history.ring[1] - MAX_SCANS)
    while (
        history.ring[1] - history.ring[0] > 2
        and history.time[(history.ring[0] + 1) % MAX_SCANS] < history.time[new] - WINDOW
    ):
        history.ring[0] += 1
    first = history.ring[0] % MAX_SCANS
    odometry, scans = np.empty(3), np.empty(3)
    between(history.odometry[first], history.odometry[new], odometry)
    between(history.matched[first], history.matched[new], scans)
    reason = _motion_difference(odometry, scans)
    if reason == NONE or _mahalanobis2(history, odometry, scans) <= GATE:
        return NONE
    return reason


@kernel
def _motion_difference(odometry: Array, scans: Array) -> int:
    """Return how the motion by odometry differs from that by scans; `NONE` if it may just be noise.

    Odometry misses a good part of the distance or the turn, or reports a turn that the scans do not show.
    """
    distance, expected = math.hypot(odometry[0], odometry[1]), math.hypot(scans[0], scans[1])
    short = distance < MIN_REPORTED * expected - MIN_MISSING[0]
    if short or abs(odometry[2]) < MIN_REPORTED * abs(scans[2]) - MIN_MISSING[1]:
        stationary = distance < STATIONARY_SHARE * expected and abs(odometry[2]) < MIN_MISSING[1]
        return PUSHED if stationary else SLIPPED
    difference = abs(wrap_in_kernel(odometry[2] - scans[2]))
    return SLIPPED if difference >= MAX_TURN_DIFFERENCE else NONE


@kernel
def _mahalanobis2(history: MatchHistory, odometry: Array, scans: Array) -> float:
    """Return d^T S^-1 d of the two motions (3,) from the first pose to the newest."""
    first, new, d = history.ring[0] % MAX_SCANS, (history.ring[1] - 1) % MAX_SCANS, np.empty(3)
    between(odometry, scans, d)
    S = rotate_covariance(history.spread[new] - history.spread[first], -history.odometry[new, 2])
    distance = max(abs(odometry[0]), abs(scans[0]), abs(odometry[1]), abs(scans[1]))
    turn = max(abs(odometry[2]), abs(scans[2]))
    # At worst, odometry's heading was wrong from the start: the distance is its lever.
    by_heading = S[2, 2]
    S[0, 0] += (
        MATCH_SIGMA[0] ** 2 + (MATCH_ERROR_SHARE * distance) ** 2 + odometry[1] ** 2 * by_heading
    )
    S[1, 1] += (
        MATCH_SIGMA[1] ** 2 + (MATCH_ERROR_SHARE * distance) ** 2 + odometry[0] ** 2 * by_heading
    )
    S[2, 2] += MATCH_SIGMA[2] ** 2 + (MATCH_ERROR_SHARE * turn) ** 2
    x = d.copy()
    if not solve(S, x):
        return 0.0
    return float(d[0] * x[0] + d[1] * x[1] + d[2] * x[2])


@kernel
def _substitute(
    d_pose: Array,
    covariance: Array,
    before: Array,
    matched: Array,
    spread: Array,
    history: MatchHistory,
) -> None:
    """Replace the motion by the one that leads from the motions used so far to the matched pose.

    Landmarks may already have corrected what it adds to the newest motion, so all of that is uncertain.
    """
    first, new = history.ring[0] % MAX_SCANS, (history.ring[1] - 1) % MAX_SCANS
    scans, used, new_motion, extra = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    between(history.matched[first], history.matched[new], scans)
    between(history.used[first], history.used[new], used)
    between(used, scans, new_motion)
    if before.any():
        between(d_pose, new_motion, extra)
    else:
        between(matched, new_motion, extra)
    distance, turn = math.hypot(matched[0], matched[1]), abs(matched[2])
    rate = MATCH_ERROR_SHARE**2 * LENGTH
    d_pose[:] = new_motion
    for a in range(3):
        for b in range(3):
            covariance[a, b] = spread[a, b] + extra[a] * extra[b]
        covariance[a, a] += rate * (turn if a == 2 else distance)
