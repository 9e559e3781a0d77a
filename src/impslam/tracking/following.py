"""Follows a robot by its scans: one compiled loop from sweep to sweep.

A sweep is matched when odometry has moved since the last match or when its ranges have changed: odometry
may stand while the robot moves, so that it alone does not decide. The prior is odometry, corrected by the
bias learned so far, with heavy tails: wheels slip, and robots push against walls. Where the scan fits
much worse than its predecessors did, the pose is searched for around several predictions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.algebra import between, invert, turned
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chain import advance, advance_pose
from impslam.geometry.kernels import kernel
from impslam.health import ELSEWHERE, NONE, UNEXPLAINED
from impslam.noise import UNKNOWN
from impslam.surfaces.features import Features, find_features, leave_out_grazing
from impslam.surfaces.surface_map import Alignment, Evidence, align
from impslam.tracking.base import Gate, Steps, go, passed
from impslam.tracking.doubt import FITS, Doubt, Fit, compare, judge, lasting
from impslam.tracking.hypotheses import Prediction, chi2_of, is_steady, reconsider, search
from impslam.tracking.learned_odometry import LearnedOdometry, correct, learn, variances
from impslam.tracking.submaps import Submaps, extend, is_empty, oldest
from impslam.types import Array, Mask

MOVED = (0.05, 0.04)
"""m, rad: a scan is matched when odometry has moved by so much. Matching closer scans gains nothing,
and every 10 cm costs a fifth of the accuracy."""
CHANGED, CHANGED_SHARE = (0.03, 0.005), 0.1
"""m, and share of the range: a range changes by more where something moved (3 sigma of the noise); and
the share of ranges that have to, since people change some of them."""
FEWEST = 10
"""Points that a scan is matched with at least."""
SLIP = (0.1, 0.025)
"""m, rad: a difference from odometry that is smaller is no slip, however sure odometry is."""
SLIP_SIGMAS = 3.0
"""Standard deviations of odometry below which a difference is no slip."""
SOUGHT = 0.7
"""Share of the mean inlier share below which the pose is searched for."""
SURE = 1e-4
"""m, rad: no match is surer."""
LOCATED = 0.02
"""m, 1 sigma: the position is known where the scan alone leaves less, or less than odometry does."""
DEGENERATE = 0.05
"""Share of the information along one axis that is at least along the other: a twentieth of the points
face along a corridor's axis where it ends in view; fewer are lone points that may be anywhere."""
NORMALS = 0.03
"""rad, 1 sigma: error of a normal, of three points 0.25 m apart that scatter by 1 cm."""
USUAL = 0.8
"""Inlier share of scans indoors; information falls with its fourth power below: people, bushes, a ramp."""
RESIDUAL = 0.02
"""m, root mean square distance from the surfaces indoors; information falls with its square above."""
MEMORY = 0.3, 0.2, 0.01
"""Weights of the newest scan in the running means of inlier share, of squared distance, and of the
time between scans."""
SPEED, RATE = 0.3, 0.6
"""m/s, rad/s: how much the velocity of a robot without odometry changes from scan to scan: half of a
walking pace, as from 0.2 to 0.5 m/s does equally well."""
LONGEST_COAST = 1.0
"""s between scans at most: stamps may jump. At least it is their mean, for stamps may stand, too."""


class Settings(NamedTuple):
    """How scans are matched; see the parameters of `ScanToMap`."""

    match: Alignment
    length: float
    spacing: float
    turn: float
    thin: float
    drift: Array


class State(NamedTuple):
    """Where the robot is; kernels change all of it in place.

    Attributes
    ----------
    submaps, odometry : the last metres, and what odometry is worth
    pose, matched : (3,) in the frame of the submaps: now, and at the newest match
    since, covariance : (3,), (3, 3) odometry since the newest match
    lengths : (3,) m, rad and s that are in it
    velocity : (3,) motion between the last two matches
    prior : (2,) variances of the prediction of the pose: m^2 along each axis, rad^2
    unlocated : (1,) s for which no scan has told the velocity of a robot without odometry
    means : (3,) running means of the inlier share, of the squared distance, m^2, and of the time
        between scans, s
    evidence : of the newest match
    doubt : whether the newest scans show the submaps
    """

    submaps: Submaps
    odometry: LearnedOdometry
    pose: Array
    matched: Array
    since: Array
    covariance: Array
    lengths: Array
    velocity: Array
    prior: Array
    unlocated: Array
    means: Array
    evidence: Evidence
    doubt: Doubt


class Seen(NamedTuple):
    """What one lidar saw last.

    Attributes
    ----------
    ranges : (n,) m, of its newest scan that was matched; 0 where invalid
    added : (3,) pose at which its newest scan was added to the submaps; NaN before the first
    """

    ranges: Array
    added: Array


class Beams(NamedTuple):
    """The columns of `Scans` that are matched; `spacing` rad is the angle between neighbours."""

    points: Array
    valid: Mask
    ranges: Array
    origins: Array
    spacing: float


@kernel
def follow(
    motions: Motions,
    beams: Beams,
    state: State,
    seen: Seen,
    gate: Gate,
    how: Settings,
    out: Steps,
) -> None:
    """Fill `out` for the next m sweeps of a lidar, and take them into its state."""
    features = np.empty((beams.points.shape[1], 5), np.float32)
    before, d_pose = np.empty(3), np.empty(3)
    for k in range(len(motions.stamps)):
        before[:] = state.pose
        alone = _predict(motions, k, state, d_pose)
        out.d_pose[k], out.covariance[k] = state.since, state.covariance
        ends = passed(gate, d_pose, motions.duration[k])
        doubted = state.doubt.poor[0] > 0.0
        if ends or alone or doubted or _due(beams.ranges[k], beams.valid[k], state, seen):
            count = _find_features(beams, k, alone, how, features)
            if count < FEWEST:
                state.submaps.way[0] += state.lengths[0]
            else:
                _match(features[:count], k, alone, state, how, out)
                if out.reasons[k] == ELSEWHERE:  # the next maps begin here
                    state.submaps.way[:], seen.added[:] = math.nan, math.nan
                if out.reasons[k] != UNEXPLAINED:
                    _remember(features[:count], k, beams, state, seen, how)
            out.reference[k] = True
            state.matched[:] = state.pose
            state.since[:], state.covariance[:], state.lengths[:] = 0.0, 0.0, 0.0
        else:
            out.reasons[k], out.amounts[k] = lasting(state.doubt, state.lengths[2])
        between(before, state.pose, out.moved[k])
        ends = passed(gate, out.moved[k], motions.duration[k])
        go(gate, out.moved[k], motions.duration[k])
        out.ends[k] = out.reference[k] and (ends or out.reasons[k] == ELSEWHERE)
        if out.ends[k]:
            gate.travelled[:] = 0.0


@kernel
def _predict(motions: Motions, k: int, state: State, d_pose: Array) -> bool:
    """Predict the pose of sweep k, by odometry or else at constant velocity; tell whether by the latter.

    Velocity is per sweep, since there are logs whose stamps run backwards.
    """
    alone = bool(motions.covariance[k, 0, 0] >= 0.5 * UNKNOWN)  # cut and composed, it is rounded
    spread = motions.covariance[k].copy()
    if alone:
        seconds = min(motions.duration[k], LONGEST_COAST)
        state.means[2] += MEMORY[2] * (seconds - state.means[2])
        seconds = max(seconds, state.means[2])
        d_pose[:], spread[:] = state.velocity, 0.0
        place, heading = (SPEED * seconds + 0.01) ** 2, (RATE * seconds + 0.01) ** 2
        spread[0, 0], spread[1, 1], spread[2, 2] = place, place, heading
    else:
        d_pose[:] = motions.d_pose[k]
        correct(state.odometry, d_pose)
    state.lengths[0] += math.hypot(d_pose[0], d_pose[1])
    state.lengths[1] += abs(d_pose[2])
    state.lengths[2] += motions.duration[k]
    if not alone:
        place, heading = variances(state.odometry, state.lengths[0], state.lengths[1])
    state.prior[0], state.prior[1] = place, heading
    advance_pose(state.pose, d_pose)
    advance(state.since, state.covariance, d_pose, spread)
    return alone


@kernel
def _find_features(beams: Beams, k: int, alone: bool, how: Settings, out: Features) -> int:
    """Fill `out` with the features of sweep k that are matched; return how many there are."""
    count = find_features(
        beams.points[k], beams.valid[k], beams.ranges[k], beams.origins[k],
        beams.spacing, how.thin, out,
    )  # fmt: skip
    if alone:
        count = leave_out_grazing(out[:count])
    return count


@kernel
def _due(ranges: Array, valid: Mask, state: State, seen: Seen) -> bool:
    """Tell whether a scan is to be matched."""
    far = math.hypot(state.since[0], state.since[1]) >= MOVED[0]
    if np.isnan(seen.added[0]) or far or abs(state.since[2]) >= MOVED[1]:
        return True
    both = changed = 0
    for i in range(len(ranges)):
        if valid[i] and seen.ranges[i] > 0.0:
            both += 1
            changed += abs(ranges[i] - seen.ranges[i]) > CHANGED[0] + CHANGED[1] * ranges[i]
    return changed > CHANGED_SHARE * both


@kernel
def _remember(
    features: Features, k: int, beams: Beams, state: State, seen: Seen, how: Settings
) -> None:
    """Keep the ranges of sweep k, and add it to the submaps unless it is near the one added last."""
    for i in range(len(seen.ranges)):
        seen.ranges[i] = beams.ranges[k, i] if beams.valid[k, i] else 0.0
    new, pose = seen.added, state.pose
    far = math.hypot(pose[0] - new[0], pose[1] - new[1]) >= how.spacing
    if np.isnan(new[0]) or far or abs(wrap_in_kernel(pose[2] - new[2])) >= how.turn:
        extend(state.submaps, features, pose, how.length)
        new[:] = pose


@kernel
def _match(
    features: Features, k: int, alone: bool, state: State, how: Settings, out: Steps
) -> None:
    """Match sweep k, and take it into the state; one that does not fit changes only the doubt."""
    if is_empty(state.submaps):
        return
    guess, means = state.pose.copy(), state.means.copy()
    usual, H, W = means[0], np.empty((3, 3)), np.empty(3)
    share = _find(features, state, how, H, W)
    if alone:
        _discount(H)
    off = np.empty(3)
    between(guess, state.pose, off)
    fit = Fit(state.evidence.sums[0], share, off)
    out.reasons[k] = judge(state.doubt, fit, usual, state.lengths[2])
    if out.reasons[k] != NONE:
        out.amounts[k] = share
        state.pose[:], state.means[:] = guess, means
        return
    state.means[0] += MEMORY[0] * (share - usual)
    enough = LOCATED**-2 if alone else min(1.0 / state.prior[0], LOCATED**-2)
    weakest, strongest, axis = _information(H)
    sure = weakest > enough and weakest > DEGENERATE * strongest
    out.located[k] = share >= FITS * usual and sure
    if not alone:
        _learn(state, fit, out.located[k])
    spread = turned(state.covariance, state.matched[2])
    _fuse(state, how, guess, H, W, spread)
    between(state.matched, state.pose, state.velocity)
    far = W[0] * state.prior[0] < 0.1  # beyond three times what counts fully
    if alone:
        _coast(state, out.located[k], weakest, axis, spread)
    told = state.velocity if alone else state.since
    out.reasons[k], out.amounts[k] = compare(
        state.doubt, told, state.velocity, out.located[k], far, state.lengths[2]
    )
    out.d_pose[k], out.covariance[k] = state.velocity, turned(spread, -state.matched[2])
    state.submaps.way[0] += math.hypot(state.velocity[0], state.velocity[1])
    _add_drift(state.velocity, how.drift, out.covariance[k])


@kernel
def _learn(state: State, fit: Fit, located: bool) -> None:
    """Learn what odometry is worth from a match."""
    plausible = fit.share > 0.6 and abs(fit.off[2]) < 4.0 * math.sqrt(state.prior[1])
    plausible = plausible and abs(fit.off[0]) < 4.0 * math.sqrt(state.prior[0])
    quality = min(1.0, state.means[0] / USUAL) ** 4
    learn(state.odometry, state.since, fit.off, plausible, state.pose, quality, located)


@kernel
def _add_drift(motion: Array, drift: Array, covariance: Array) -> None:
    """Add what matched motion strays by, the mean square of errors with heavy tails, as on ramps."""
    way, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
    covariance[0, 0] += drift[0] ** 2 * way
    covariance[1, 1] += drift[1] ** 2 * way
    covariance[2, 2] += drift[2] ** 2 * way + drift[3] ** 2 * turn


@kernel
def _coast(state: State, located: bool, weakest: float, axis: float, spread: Array) -> None:
    """Widen the covariance (3, 3) of a motion at constant velocity along the axis that scans leave open.

    The velocity may be off by `SPEED`, for as long as no scan tells it, and the position by `SPEED` times
    that time. A scan of information `weakest` along the axis shortens the time by its Kalman gain.
    """
    seconds = min(state.lengths[2], LONGEST_COAST)
    odds = max(weakest, 0.0) * (SPEED * seconds) ** 2
    state.unlocated[0] = (state.unlocated[0] + seconds) / (1.0 + odds)
    if not located:
        state.doubt.bare[0] = max(state.doubt.bare[0], SPEED * state.unlocated[0])
    variance = 2.0 * SPEED**2 * state.unlocated[0] * seconds
    _add_along(spread, axis, variance)


@kernel
def _add_along(M: Array, axis: float, amount: float) -> None:
    """Add to the position's part of M (3, 3) an amount along an axis (rad)."""
    x, y = math.cos(axis), math.sin(axis)
    M[0, 0] += amount * x * x
    M[0, 1] += amount * x * y
    M[1, 0] += amount * x * y
    M[1, 1] += amount * y * y


@kernel
def _information(H: Array) -> tuple[float, float, float]:
    """Return the least and the most of H (3, 3) on a position whose heading is unknown, 1/m^2.

    The third value is the direction of the least, rad.
    """
    if not H[2, 2] > 0.0:
        return 0.0, 0.0, 0.0
    xx, yy = H[0, 0] - H[0, 2] ** 2 / H[2, 2], H[1, 1] - H[1, 2] ** 2 / H[2, 2]
    xy = H[0, 1] - H[0, 2] * H[1, 2] / H[2, 2]
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return mean - half, mean + half, 0.5 * math.atan2(-2.0 * xy, yy - xx)


@kernel
def _discount(H: Array) -> None:
    """Subtract from H (3, 3) the spurious information along walls that errors of normals cause.

    Of a wall's information the share `NORMALS`^2 appears along the wall, which would hold a robot
    without odometry in place: subtracted along the axis of the least, where it shows.
    """
    weakest, strongest, axis = _information(H)
    _add_along(H, axis, -max(min(NORMALS**2 * strongest, weakest), 0.0))


@kernel
def _find(features: Features, state: State, how: Settings, H: Array, W: Array) -> float:
    """Bring the pose to where the scan fits best; return the inlier share.

    H (3, 3) becomes the information of the scan, W (3,) that of the prior as far as it counts there,
    both along the axes of the submaps.
    """
    known, usual = oldest(state.submaps), state.means[0]
    place, heading = state.prior[0], state.prior[1]
    prior = np.array([1.0 / place, 1.0 / place, 1.0 / heading])
    slack2 = max(SLIP_SIGMAS**2, min(SLIP[0] ** 2 / place, SLIP[1] ** 2 / heading))
    worth = how.match.information * min(1.0, max(usual, 0.05) / USUAL) ** 4
    worth *= min(1.0, RESIDUAL**2 / state.means[1])
    match = Alignment(
        how.match.iterations, how.match.wide, how.match.narrow, worth, how.match.step, slack2
    )
    going = state.matched.copy()
    advance_pose(going, state.velocity)
    predicted = Prediction(state.pose.copy(), prior, state.matched, going, usual)
    share = align(known, features, state.pose, prior, match, state.evidence)
    if not is_steady(state.pose, predicted):
        share = reconsider(known, features, predicted, match, state.pose, state.evidence)
    if state.evidence.sums[3] > 5.0:
        square = state.evidence.sums[2] / state.evidence.sums[3]
        state.means[1] += MEMORY[1] * (square - state.means[1])
    if share < SOUGHT * usual:
        share = search(known, features, predicted, match, state.pose, state.evidence)
    chi2 = chi2_of(state.pose, predicted)
    H[:] = worth * state.evidence.H
    W[:] = prior / (1.0 + chi2 / slack2)
    return share


@kernel
def _fuse(state: State, how: Settings, guess: Array, H: Array, W: Array, spread: Array) -> None:
    """Move the pose from the best match to where match and prior meet; give its covariance, (3, 3).

    Matches of one stretch err alike: surfaces are not the same from everywhere, and grass, ramps and
    people move along. So a match is no surer than D, what matched motion strays by over the way since
    the last one, however many points it has: its information is (H^-1 + D)^-1. That and its product
    with the best match are written with A = (H + D^-1)^-1, since H has no inverse along a corridor.
    """
    way, turn, d = state.lengths[0] + MOVED[0], state.lengths[1] + MOVED[1], np.empty(3)
    d[0] = d[1] = 1.0 / (max(how.drift[0], how.drift[1]) ** 2 * way + SURE**2)
    d[2] = 1.0 / (how.drift[2] ** 2 * way + how.drift[3] ** 2 * turn + SURE**2)
    A, pull, step = H.copy(), np.empty(3), np.empty(3)
    for a in range(3):
        A[a, a] += d[a]
    if not invert(A):
        return
    pull[0], pull[1] = W[0] * (state.pose[0] - guess[0]), W[1] * (state.pose[1] - guess[1])
    pull[2] = W[2] * wrap_in_kernel(state.pose[2] - guess[2])
    posterior = np.empty((3, 3))
    for a in range(3):
        step[a] = d[a] * (A[a, 0] * pull[0] + A[a, 1] * pull[1] + A[a, 2] * pull[2]) - pull[a]
        for b in range(3):
            posterior[a, b] = -d[a] * A[a, b] * d[b]
        posterior[a, a] += d[a] + W[a]
    if invert(posterior):
        spread[:] = posterior
        step = posterior @ step
        state.pose[0] += step[0]
        state.pose[1] += step[1]
        state.pose[2] = wrap_in_kernel(state.pose[2] + step[2])
