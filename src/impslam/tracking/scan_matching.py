"""Track the robot by scan matching: one compiled loop over sweeps.

The prior is odometry, corrected by the bias learned so far, with heavy tails: wheels slip, and robots push
against walls. If the scan fits much worse than previous ones, the pose is searched for around several
predictions. See `due` for which sweeps are matched.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.columns import Motions
from impslam.geometry.algebra import between, rotate_covariance
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.health import ELSEWHERE, UNEXPLAINED
from impslam.surfaces.features import Features
from impslam.tracking.base import Gate, add_travel, reaches_limit
from impslam.tracking.beams import BeamColumns
from impslam.tracking.carried import begin_place, notice_carried
from impslam.tracking.contradictions import (
    CLEARANCE,
    MIN_CONTRADICTED,
    contradicted_share,
    shows_surfaces,
)
from impslam.tracking.deskewing_by_match import (
    MIN_POINTS,
    deskew_alone,
    deskew_slip,
    find_matched_features,
)
from impslam.tracking.due import is_due
from impslam.tracking.frozen import notice_frozen
from impslam.tracking.fusion import coast, fuse
from impslam.tracking.hypotheses import MAX_SLIP, SLIP_SIGMAS
from impslam.tracking.intervals import add_interval, is_gap
from impslam.tracking.learned_odometry import learn
from impslam.tracking.match_faults import (
    MIN_FIT,
    WINDOW,
    MatchQuality,
    add_fit,
    add_misfit,
    check_motion,
    current_fault,
    disputed_variance,
    fits_poorly,
    is_odometry_wrong,
)
from impslam.tracking.match_information import (
    MAX_NORMAL_ERROR,
    NORMAL_ERROR,
    add_along,
    add_drift,
    hold_along,
    information,
)
from impslam.tracking.matching_state import (
    DISTANCE,
    HEADING,
    POSITION,
    SECONDS,
    SHARE,
    SQUARE,
    ScanMatch,
    Settings,
    State,
)
from impslam.tracking.pose_prediction import predict
from impslam.tracking.pose_search import USUAL_SHARE, find_pose
from impslam.tracking.reference_scan import LastScan
from impslam.tracking.stall import IS_STALLED
from impslam.tracking.stalled import predict_stalled, report_stalled, set_reference_pose
from impslam.tracking.steps import Steps
from impslam.tracking.submaps import confirmed_surfels, extend, is_empty

MAX_NEW_VIEW = 0.14
"""Share of the view that a turn may show anew before a scan is added to the submaps: 0.14 rad of a depth
camera's 57 deg. Above 164 deg, `Settings.turn` is less."""
MAX_LOCATED_SIGMA = 0.02
"""m, 1 sigma: a scan locates the robot if it alone determines the position better than this, or better than
odometry does."""
MAX_ODOMETRY_SIGMA = 0.5 * CLEARANCE
"""m, 1 sigma of the predicted position: if it is larger, odometry cannot tell which surfaces the last scan
did not see, since those that it saw end within `CLEARANCE`."""
MIN_INFORMATION_RATIO = 0.05
"""Smallest ratio of the information along the weakest and the strongest axis: a twentieth of the points
face along a corridor whose end is in view; fewer are lone points that may be anywhere."""


@kernel
def follow(
    motions: Motions,
    beams: BeamColumns,
    state: State,
    gate: Gate,
    settings: Settings,
    out: Steps,
) -> None:
    """Fill `out` for the next m sweeps of a lidar, and update the state."""
    before, d_pose = np.empty(3), np.empty(3)
    for k in range(len(motions.stamps)):
        before[:] = state.pose
        no_odometry = predict(motions, k, state, d_pose)
        out.d_pose[k], out.covariance[k] = state.motion, state.covariance
        at_limit = reaches_limit(gate, d_pose, motions.duration[k])
        in_doubt = state.faults.poor[0] > 0.0
        wanted = at_limit or no_odometry or in_doubt or state.proven[0] > 0.0
        wanted |= state.reach[POSITION] > 0.0
        if wanted or is_due(beams.ranges[k], beams.valid[k], state):
            _use_scan(k, no_odometry, motions, beams, state, settings, out)
        else:
            out.reasons[k], out.amounts[k] = current_fault(state.faults, state.travelled[SECONDS])
        between(before, state.pose, out.moved[k])
        at_limit = reaches_limit(gate, out.moved[k], motions.duration[k])
        at_limit |= notice_carried(beams, k, state, motions.duration[k], out)
        at_limit |= out.reach[k, 0] > 0.0
        add_travel(gate, out.moved[k], motions.duration[k])
        add_interval(motions.duration[k], state.intervals, WINDOW)
        out.is_keyframe[k] = out.reference[k] and (at_limit or out.reasons[k] == ELSEWHERE)
        if out.is_keyframe[k]:
            gate.travelled[:] = 0.0
            state.error[:] = 0.0


@kernel
def _use_scan(
    k: int,
    no_odometry: bool,
    motions: Motions,
    beams: BeamColumns,
    state: State,
    settings: Settings,
    out: Steps,
) -> None:
    """Match sweep k if it has enough points, and begin the next motion at its pose."""
    features = np.empty((beams.points.shape[1], 5), np.float32)
    # An error of the heading at the last match has moved the position since.
    advance(state.matched.copy(), state.error, state.motion, np.zeros((3, 3)))
    if no_odometry and not state.frozen.is_frozen[0] and len(beams.after):
        deskew_alone(k, motions.duration[k], beams, state, settings, features)
    count = find_matched_features(beams, k, no_odometry, settings, features)
    if not no_odometry and len(beams.after):
        count = deskew_slip(k, count, beams, state, settings, features)
    if count < MIN_POINTS:
        state.submaps.travelled[0] += state.travelled[DISTANCE]
    else:
        stalled = not no_odometry and predict_stalled(beams, k, state)
        fits = _match(features[:count], k, no_odometry, beams, state, settings, out)
        if stalled:
            report_stalled(k, state, out)
        if out.reasons[k] == ELSEWHERE:
            begin_place(state)
            fits = True
        moved_on = notice_frozen(k, motions.duration[k], state, settings, out)
        if out.reasons[k] != UNEXPLAINED:
            _add_to_submaps(features[:count], k, beams, state, settings, moved_on, fits)
    out.error[k] = rotate_covariance(state.error, -state.matched[2])
    out.reference[k] = True
    set_reference_pose(state)
    state.matched[:] = state.pose
    state.motion[:], state.covariance[:], state.travelled[:], state.reported[0] = 0.0, 0.0, 0.0, 0.0


@kernel
def _add_to_submaps(
    features: Features,
    k: int,
    beams: BeamColumns,
    state: State,
    settings: Settings,
    moved_on: bool,
    fits: bool,
) -> None:
    """Store the ranges of sweep k, and add it to the submaps unless it is near the one added last.

    `moved_on` is whether the robot may have moved on, see `notice_frozen`: then things that come into view
    show how far it moves, but only if the submaps contain them.
    """
    lidar = state.lidar
    lidar.pose[:] = state.pose
    lidar.ranges[:] = beams.ranges[k]
    new, pose = lidar.added, state.pose
    far = math.hypot(pose[0] - new[0], pose[1] - new[1]) >= settings.spacing
    view = abs(beams.geometry.spacing) * (beams.ranges.shape[1] - 1)
    far |= abs(wrap_in_kernel(pose[2] - new[2])) >= min(settings.turn, MAX_NEW_VIEW * view)
    if np.isnan(new[0]) or far or moved_on:
        extend(state.submaps, features, pose, settings.length, fits)
        new[:] = pose


@kernel
def _match(
    features: Features,
    k: int,
    no_odometry: bool,
    beams: BeamColumns,
    state: State,
    settings: Settings,
    out: Steps,
) -> bool:
    """Match sweep k and update the state; return whether it fits.

    A sweep that fits poorly and contradicts the submaps changes only `faults`.
    """
    if is_empty(state.submaps):
        return True
    guess, means = state.pose.copy(), state.averages.copy()
    usual, H, W = means[SHARE], np.empty((3, 3)), np.empty(3)
    share = find_pose(features, _last_scan(beams, state, no_odometry), state, settings, H, W)
    found, held, matched = state.pose.copy(), state.pose.copy(), state.matched.copy()
    per_metre = MAX_NORMAL_ERROR if no_odometry else NORMAL_ERROR
    hold_along(H, W, per_metre * math.sqrt(state.averages[SQUARE]), guess, held)
    if not no_odometry:
        state.pose[:] = held
    off = np.empty(3)
    between(guess, state.pose, off)
    fit = MatchQuality(state.evidence.sums[0], share, off)
    poor = fits_poorly(state.faults, fit, usual)
    if poor and (not shows_surfaces(features) or _contradicts(beams, k, state, no_odometry)):
        distance, seconds = state.travelled[DISTANCE], state.travelled[SECONDS]
        out.reasons[k], out.amounts[k] = add_misfit(state.faults, seconds, distance), share
        state.pose[:], state.averages[:] = guess, means
        return False
    if poor:  # what the scan shows is not in the map yet
        state.averages[:] = means
        state.faults.poor[:] = 0.0
    else:
        add_fit(state.faults, fit, usual)
    _move(ScanMatch(guess, fit, usual, H, W), k, no_odometry, state, settings, out)
    if no_odometry:  # a pull that normals may cause must not change the velocity
        between(matched, state.pose + held - found, state.velocity)
    return not poor


@kernel
def _last_scan(beams: BeamColumns, state: State, no_odometry: bool) -> LastScan:
    """Return the scan matched before, with no ranges if odometry is absent, wrong or uncertain.

    Then surfaces that fit are all that shows where the robot is.
    """
    ranges, useless = state.lidar.ranges, no_odometry or is_odometry_wrong(state.faults)
    useless |= state.prior[POSITION] > MAX_ODOMETRY_SIGMA**2
    return LastScan(ranges[:0] if useless else ranges, state.lidar.pose, beams.geometry)


@kernel
def _move(
    match: ScanMatch, k: int, no_odometry: bool, state: State, settings: Settings, out: Steps
) -> None:
    """Update the state with the motion to a match, fused with the prior, and write that motion."""
    located = MAX_LOCATED_SIGMA**-2
    enough = located if no_odometry else min(1.0 / state.prior[POSITION], located)
    weakest, strongest, axis = information(match.H)
    well_constrained = weakest > enough and weakest > MIN_INFORMATION_RATIO * strongest
    out.located[k] = match.fit.share >= MIN_FIT * match.usual and well_constrained
    if not no_odometry:
        _learn(state, match, out.located[k])
    covariance = rotate_covariance(state.covariance, state.matched[2])
    fuse(state, settings, match.guess, match.H, match.W, covariance)
    between(state.matched, state.pose, state.velocity)
    weight = match.W[0] * (state.prior[POSITION] + state.slip[POSITION])
    far = weight < 0.1  # beyond three times the range of full weight
    if no_odometry:
        coast(state, out.located[k], weakest, axis)
    odometry_motion = state.velocity if no_odometry else state.motion
    if state.frozen.is_frozen[0]:
        odometry_motion = np.zeros(3)
    out.reasons[k], out.amounts[k] = check_motion(
        state.faults, odometry_motion, state.velocity, out.located[k], far, state.travelled[SECONDS]
    )
    out.d_pose[k] = state.velocity
    out.covariance[k] = rotate_covariance(covariance, -state.matched[2])
    disputed = disputed_variance(state.faults, odometry_motion, state.velocity)
    add_along(out.covariance[k], 0.0, disputed)
    out.reach[k] = state.reach
    state.reach[:] = 0.0
    state.submaps.travelled[0] += math.hypot(state.velocity[0], state.velocity[1])
    add_drift(state.velocity, settings.drift, out.covariance[k])


@kernel
def _contradicts(beams: BeamColumns, k: int, state: State, no_odometry: bool) -> bool:
    """Return whether sweep k, which fits poorly at the current pose, contradicts what was seen before.

    After a gap that odometry does not cover, and after a scan that did, every such sweep does: the robot
    may be anywhere.
    """
    variance = SLIP_SIGMAS**2 * (state.covariance[0, 0] + state.covariance[1, 1])
    covered = not no_odometry and variance < MAX_SLIP[0] ** 2
    gap = is_gap(state.interval[0], state.intervals, WINDOW)
    if state.faults.poor[0] > 0.0 or (gap and not covered):
        return True
    last = LastScan(state.lidar.ranges, state.lidar.pose, beams.geometry)
    surfels = confirmed_surfels(state.submaps)
    share = contradicted_share(beams.ranges[k], beams.valid[k], state.pose, surfels, last)
    return share > MIN_CONTRADICTED


@kernel
def _learn(state: State, match: ScanMatch, located: bool) -> None:
    """Learn the bias and noise of odometry from a match."""
    fit, turned = match.fit, bool(match.H[2, 2] * state.prior[HEADING] > 1.0)
    plausible = fit.share > 0.6 and not state.lidar.stall.flags[IS_STALLED]
    plausible = plausible and abs(fit.off[2]) < 4.0 * math.sqrt(state.prior[HEADING])
    plausible = plausible and abs(fit.off[0]) < 4.0 * math.sqrt(state.prior[POSITION])
    quality = min(1.0, state.averages[SHARE] / USUAL_SHARE) ** 4
    learn(state.odometry, state.motion, fit.off, plausible, state.pose, quality, (located, turned))
