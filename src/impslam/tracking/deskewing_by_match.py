"""De-skew a sweep by the motion that a first match of it shows, before it is matched.

Without odometry, nothing else shows the motion. With it, wheels slip in turns, or the configured track is
wrong: at 2 rad/s, a fifth of the turn distorts a sweep of 0.2 s by 5 deg from its first to its last beam.
"""

from __future__ import annotations

import numpy as np

from impslam.geometry.algebra import between
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features, leave_out_oblique
from impslam.surfaces.surface_map import Alignment, align, no_evidence
from impslam.tracking.beams import BeamColumns, beams_of, find_beam_features
from impslam.tracking.fusion import MIN_MOTION, MIN_SLIP, RATE_SIGMA
from impslam.tracking.hypotheses import SLIP_SIGMAS
from impslam.tracking.matching_state import SHARE, Settings, State
from impslam.tracking.pose_search import SEARCH_BELOW, find_pose, prior_information
from impslam.tracking.reference_scan import LastScan
from impslam.tracking.submaps import is_empty, older_map
from impslam.tracking.sweep_twist import MAX_TURN_RATIO, deskew, set_twist

MIN_POINTS = 10
"""Points; a scan with fewer is not matched."""
TURN_CHANGES = (0.0, 1.0, -1.0, 2.0, -2.0)
"""Multiples of `RATE_SIGMA` by which the turn rate may have changed since the last sweep."""


@kernel
def find_matched_features(
    beams: BeamColumns, k: int, no_odometry: bool, settings: Settings, out: Features
) -> int:
    """Fill `out` with the features of sweep k to match; return their number."""
    count = find_beam_features(beams, k, settings.thin, settings.smooth, out)
    if no_odometry:
        count = leave_out_oblique(out[:count])
    return count


@kernel
def deskew_alone(
    k: int, seconds: float, beams: BeamColumns, state: State, settings: Settings, features: Features
) -> None:
    """De-skew sweep k of a robot without odometry, `seconds` after the last one.

    For the first match it is de-skewed with the last velocity. Where a turn begins within a sweep, the
    beams before may fit as if there was none, so other turn rates are tried if the sweep fits poorly.
    `features` are overwritten.
    """
    twist, known, motion = np.zeros(3), np.zeros(3), state.velocity.copy()
    guess, means, best = state.pose.copy(), state.averages.copy(), -1.0
    last = LastScan(state.lidar.ranges[:0], state.lidar.pose, beams.geometry)
    for change in TURN_CHANGES:
        if is_empty(state.submaps) or best > SEARCH_BELOW * means[SHARE]:
            break
        trial = state.velocity.copy()
        trial[2] += change * RATE_SIGMA * seconds
        set_twist(trial, trial, seconds, beams.after, twist)
        deskew(beams_of(beams, k), twist, known)
        known[:] = twist
        count = find_matched_features(beams, k, True, settings, features)
        if count < MIN_POINTS:
            return
        state.pose[:] = state.matched
        advance_pose(state.pose, trial)
        share = find_pose(features[:count], last, state, settings, np.empty((3, 3)), np.empty(3))
        if share > best:
            best = share
            between(state.matched, state.pose, motion)
        state.pose[:], state.averages[:] = guess, means
    set_twist(motion, state.velocity, seconds, beams.after, twist)
    deskew(beams_of(beams, k), twist, known)


@kernel
def deskew_slip(
    k: int, count: int, beams: BeamColumns, state: State, settings: Settings, features: Features
) -> int:
    """De-skew sweep k anew if the robot turns more or less than odometry reports.

    The `features`, of which there are `count`, are then found again; return their number.
    """
    reported = state.reported[0]
    if is_empty(state.submaps) or count < MIN_POINTS or abs(reported) < MIN_MOTION[1]:
        return count
    turned = state.motion[2] + _turn_error(features[:count], state, settings)
    if abs(turned - reported) < MIN_SLIP[1]:
        return count
    twist = beams.twists[k].copy()
    twist[2] *= min(max(turned / reported, 0.0), MAX_TURN_RATIO)
    deskew(beams_of(beams, k), twist, beams.twists[k])
    return find_matched_features(beams, k, False, settings, features)


@kernel
def _turn_error(features: Features, state: State, settings: Settings) -> float:
    """Return how much more the robot has turned than predicted, by a match of the features, rad."""
    prior = prior_information(state.prior + state.slip)
    how, pose = settings.match, state.pose.copy()
    match = Alignment(
        how.iterations, how.wide, how.narrow, how.information, how.step, SLIP_SIGMAS**2
    )
    align(older_map(state.submaps), features, pose, prior, match, no_evidence())
    return float(wrap_in_kernel(pose[2] - state.pose[2]))
