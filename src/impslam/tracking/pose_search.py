"""Find the pose of a scan in the submaps, from odometry and from other predictions."""

from __future__ import annotations

import numpy as np

from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import Alignment, SurfaceMap, align, no_evidence
from impslam.tracking.fusion import MIN_SLIP
from impslam.tracking.hypotheses import (
    SLIP_SIGMAS,
    PosePrediction,
    align_from_predictions,
    chi2_of,
    is_expected,
    search,
)
from impslam.tracking.matching_state import SHARE, SQUARE, Settings, State
from impslam.tracking.reach import is_after_gap
from impslam.tracking.reference_scan import LastScan
from impslam.tracking.submaps import older_map
from impslam.types import Array

SEARCH_BELOW = 0.7
"""Share of the mean inlier share below which the pose is searched for."""
USUAL_SHARE = 0.8
"""Inlier share of scans indoors; below, information falls with its fourth power: people, bushes, a ramp."""
USUAL_RMS = 0.02
"""m, root mean square distance from the surfaces indoors; above, information falls with its square."""
PULLED_SHARE = 0.85
"""Share of the best inlier share below which odometry pulls a scan away from where it fits. On a ramp,
where scans mislead and odometry is right, one scan in a thousand has less."""
SHARE_MEMORY, RMS_MEMORY = 0.3, 0.2
"""Weights of the newest scan in the running means of the inlier share and of the squared distance."""


@kernel
def find_pose(
    features: Features,
    last_scan: LastScan,
    state: State,
    settings: Settings,
    H: Array,
    W: Array,
) -> float:
    """Move the pose to the best fit of the scan; return the inlier share.

    The running means of the inlier share and of the squared distance are updated. H (3, 3) becomes the
    information of the scan, W (3,) that of the prior with its robust weight there, both in the frame of the
    submaps.
    """
    submap, usual = older_map(state.submaps), state.averages[SHARE]
    variances = state.prior + state.slip
    position, heading = variances
    prior = prior_information(variances)
    slack2 = max(SLIP_SIGMAS**2, min(MIN_SLIP[0] ** 2 / position, MIN_SLIP[1] ** 2 / heading))
    weight = settings.match.information * min(1.0, max(usual, 0.05) / USUAL_SHARE) ** 4
    weight *= min(1.0, USUAL_RMS**2 / state.averages[SQUARE])
    how = settings.match
    match = Alignment(how.iterations, how.wide, how.narrow, weight, how.step, slack2)
    trusted = Alignment(how.iterations, how.wide, how.narrow, how.information, how.step, slack2)
    predicted = _predictions(state, last_scan)
    share = align(submap, features, state.pose, prior, match, state.evidence)
    if not is_expected(state.pose, predicted):
        share = align_from_predictions(
            submap, features, predicted, match, state.pose, state.evidence
        )
    if state.evidence.sums[3] > 5.0:
        square = state.evidence.sums[2] / state.evidence.sums[3]
        state.averages[SQUARE] += RMS_MEMORY * (square - state.averages[SQUARE])
    if share < SEARCH_BELOW * usual:
        share = search(submap, features, predicted, match, state.pose, state.evidence)
    usable = _usable_share(submap, features, predicted, trusted, share)
    state.averages[SHARE] += SHARE_MEMORY * (usable - usual)
    chi2 = chi2_of(state.pose, predicted)
    H[:] = weight * state.evidence.H
    W[:] = prior / (1.0 + chi2 / slack2)
    return share


@kernel
def _usable_share(
    submap: SurfaceMap,
    features: Features,
    predicted: PosePrediction,
    trusted: Alignment,
    share: float,
) -> float:
    """Return the inlier share that determines the information of the next scans.

    It is `share`, that at the pose found, unless wrong odometry has pulled the scan away from where it
    fits. The next scans would then have even less information, and could never correct odometry. So it is
    the share at the pose that the scan has if it is aligned with full information (`trusted`).
    """
    if predicted.usual >= USUAL_SHARE or share >= PULLED_SHARE:  # the best share is at most 1
        return share
    pose, evidence = predicted.pose.copy(), no_evidence()
    best = align(submap, features, pose, predicted.information, trusted, evidence)
    return best if share < PULLED_SHARE * best else share


@kernel
def prior_information(variances: Array) -> Array:
    """Return the information (3,) of a pose from its variances (2,), along each axis and of its heading."""
    position, heading = variances
    return np.array([1.0 / position, 1.0 / position, 1.0 / heading])


@kernel
def _predictions(state: State, last_scan: LastScan) -> PosePrediction:
    """Return the predicted poses of a scan."""
    pose, usual = state.pose.copy(), state.averages[SHARE]
    prior = prior_information(state.prior)
    if is_after_gap(state):
        return PosePrediction(pose, prior, pose, pose, usual, last_scan)
    extrapolated = state.matched.copy()
    advance_pose(extrapolated, state.velocity)
    return PosePrediction(pose, prior, state.matched, extrapolated, usual, last_scan)
