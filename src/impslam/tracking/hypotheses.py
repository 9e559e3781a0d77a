"""Choose between several poses that fit a scan: after a slip, along a corridor, at a ramp.

Alignment finds the pose nearest to its start. In doubt it also starts elsewhere, and the most
probable pose is kept: by the points that fit, and by odometry, which is either right within its noise or,
seldom, slipped a little.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.chi_square import GATE_3D_95
from impslam.geometry.kernels import kernel
from impslam.noise import UNKNOWN
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import (
    Alignment,
    FitSums,
    SurfaceMap,
    align,
    normal_equations,
)
from impslam.tracking.reference_scan import LastScan
from impslam.tracking.unseen import unseen_points
from impslam.types import Array

MAX_VELOCITY_CHANGE = (0.1, 0.2)
"""m, rad: a match farther from constant velocity may be a wrong minimum, or odometry slipped. Indoor robots
accelerate by less than 2 m/s^2 and 5 rad/s^2, over 0.2 s at most."""
MAX_CHI2 = GATE_3D_95
"""A match farther from odometry may be a wrong minimum."""
SLIP_PROBABILITY = 1e-3
"""Share of matches preceded by a slip: ten in an hour. A slip is uniform within `MAX_SLIP`, a volume of
1 m^2 rad."""
MAX_SLIP = (0.5, 0.5)
"""m, rad: largest slip. A scan that only fits farther from all predictions shows another place."""
SLIP_SIGMAS = 3.0
"""Standard deviations of odometry; a larger difference from it is a slip."""
SEARCH_HEADINGS, SEARCH_TURN, SEARCH_OFFSET = 9, 0.06, 0.25
"""Number of headings, rad between them, and m of the offsets to try around each prediction."""
SEARCH_SCALES = (0.25, 0.1)
"""m, of the kernel in a search: as wide as its offsets at first, then as its errors after a few steps."""
SEARCH_POINTS = 60
"""Points of a scan for the first alignments, of which there are 135: enough for a rough pose."""
SEARCH_PRIOR_WEIGHT = 0.1
"""Weight of the prior while other poses are searched, relative to a match."""
MIN_GAIN, MIN_USUAL, MIN_SHARE = 0.2, 0.6, 0.5
"""What the inlier share of a new pose must exceed: that so far plus the first, the second times the usual
share, and the third; wrong poses seldom fit so well."""


class PosePrediction(NamedTuple):
    """Predicted poses (3,) of a scan before matching, in the frame of the map.

    Attributes
    ----------
    pose : by odometry
    information : (3,) of it, 1/m^2, 1/m^2, 1/rad^2, unless odometry slipped
    last, extrapolated : at the newest match, and from there at constant velocity; after a gap in the data,
        in which the robot may have gone anywhere, by odometry as well
    usual : the usual inlier share
    last_scan : the one before; without ranges if surfaces that fit are all that shows where the robot is
    """

    pose: Array
    information: Array
    last: Array
    extrapolated: Array
    usual: float
    last_scan: LastScan


@kernel
def chi2_of(pose: Array, predicted: PosePrediction) -> float:
    """Return the squared Mahalanobis distance of a pose (3,) from odometry."""
    ex, ey = pose[0] - predicted.pose[0], pose[1] - predicted.pose[1]
    et = wrap_in_kernel(pose[2] - predicted.pose[2])
    a = predicted.information
    return float(a[0] * ex * ex + a[1] * ey * ey + a[2] * et * et)


@kernel
def is_expected(pose: Array, predicted: PosePrediction) -> bool:
    """Return whether a pose (3,) is near that of odometry, and near the one at constant velocity."""
    if chi2_of(pose, predicted) > MAX_CHI2:
        return False
    d = np.empty(3)
    between(predicted.extrapolated, pose, d)
    return bool(
        math.hypot(d[0], d[1]) <= MAX_VELOCITY_CHANGE[0] and abs(d[2]) <= MAX_VELOCITY_CHANGE[1]
    )


@kernel
def is_possible(pose: Array, predicted: PosePrediction) -> bool:
    """Return whether a pose (3,) is within a slip, and odometry's own error, of one of the predictions."""
    a = predicted.information
    reach = MAX_SLIP[0] + SLIP_SIGMAS / math.sqrt(max(a[0], 1.0 / UNKNOWN))
    turn = MAX_SLIP[1] + SLIP_SIGMAS / math.sqrt(max(a[2], 1.0 / UNKNOWN))
    for at in (predicted.pose, predicted.last, predicted.extrapolated):
        near = math.hypot(pose[0] - at[0], pose[1] - at[1]) <= reach
        if near and abs(wrap_in_kernel(pose[2] - at[2])) <= turn:
            return True
    return False


@kernel
def cost(
    submap: SurfaceMap,
    features: Features,
    pose: Array,
    predicted: PosePrediction,
    match: Alignment,
    evidence: FitSums,
) -> float:
    """Return the negative log probability of a pose, up to a constant; inf if it is not possible.

    The part of the points is the Geman-McClure cost that alignment minimises: the squared scale for each
    outlier. Outliers up to their usual share do not count: they show what the map does not contain yet, and
    a pose without motion would leave the fewest of them. In a door, more of them do, so those that the last
    scan could not see do not count either. The part of odometry is that of a prior with heavy tails, or of
    a slip.
    """
    if not is_possible(pose, predicted):
        return math.inf
    missing = predicted.usual * evidence.sums[0] - evidence.sums[1]
    if missing > 0.0:
        missing -= predicted.usual * unseen_points(submap, features, pose, predicted.last_scan)
    points = match.information * match.narrow**2 * max(missing, 0.0)
    gaussian = match.slack2 * math.log(1.0 + chi2_of(pose, predicted) / match.slack2)
    a = predicted.information
    slip = math.log(a[0] * a[1] * a[2] / (2.0 * math.pi) ** 3) - 2.0 * math.log(SLIP_PROBABILITY)
    return float(0.5 * (points + min(gaussian, max(slip, 0.0))))


@kernel
def align_from_predictions(
    submap: SurfaceMap,
    features: Features,
    predicted: PosePrediction,
    match: Alignment,
    pose: Array,
    evidence: FitSums,
) -> float:
    """Align also from the last pose and from that at constant velocity; keep the pose of lowest cost.

    From these and the pose of odometry, the nearest minimum is sought, too: the wide kernel may lead away
    from it, into a worse one. `pose` (3,) and `evidence` are those of the alignment from the pose of
    odometry, and change in place. Return the inlier share.
    """
    best, other = pose.copy(), np.empty(3)
    prior = predicted.information * SEARCH_PRIOR_WEIGHT
    lowest = cost(submap, features, pose, predicted, match, evidence)
    if lowest == math.inf:
        best[:] = predicted.pose
        normal_equations(submap, features, best, match.narrow, match.step, evidence)
        lowest = cost(submap, features, best, predicted, match, evidence)
    near = Alignment(
        match.iterations, match.narrow, match.narrow, match.information, match.step, match.slack2
    )
    for start in (predicted.extrapolated, predicted.last, predicted.pose):
        for how in (match, near):
            other[:] = start
            align(submap, features, other, prior, how, evidence)
            new_cost = cost(submap, features, other, predicted, match, evidence)
            if new_cost < lowest:
                best[:], lowest = other, new_cost
    return _finish(submap, features, best, match, pose, evidence)


@kernel
def search(
    submap: SurfaceMap,
    features: Features,
    predicted: PosePrediction,
    match: Alignment,
    pose: Array,
    evidence: FitSums,
) -> float:
    """Align from poses around all predictions, and keep a clear best; see `align_from_predictions`.

    Its inlier share must be well above that so far and near the usual one, and its cost must not be
    higher, which demands a clearer best the better odometry is.
    """
    wide, middle = SEARCH_SCALES
    few = max(1, len(features) // SEARCH_POINTS)
    coarse = Alignment(8, wide, middle, match.information, few, match.slack2)
    fine = Alignment(4, middle, match.narrow, match.information, match.step, match.slack2)
    prior = predicted.information * SEARCH_PRIOR_WEIGHT
    old_cost = cost(submap, features, pose, predicted, match, evidence)
    best, other = pose.copy(), np.empty(3)
    share = evidence.sums[1] / max(evidence.sums[0], 1.0)
    min_share = max(share + MIN_GAIN, MIN_USUAL * predicted.usual, MIN_SHARE)
    for start in (predicted.pose, predicted.last, predicted.extrapolated):
        for turn in range(-(SEARCH_HEADINGS // 2), SEARCH_HEADINGS // 2 + 1):
            for offset in range(5):
                other[:] = start
                other[2] += turn * SEARCH_TURN
                other[0] += SEARCH_OFFSET * ((offset == 1) - (offset == 2))
                other[1] += SEARCH_OFFSET * ((offset == 3) - (offset == 4))
                align(submap, features, other, prior, coarse, evidence)
                share = align(submap, features, other, prior, fine, evidence)
                if share > min_share and is_possible(other, predicted):
                    best[:], min_share = other, share
    normal_equations(submap, features, best, match.narrow, match.step, evidence)
    if cost(submap, features, best, predicted, match, evidence) > old_cost:
        best[:] = pose
    return _finish(submap, features, best, match, pose, evidence)


@kernel
def _finish(
    submap: SurfaceMap,
    features: Features,
    best: Array,
    match: Alignment,
    pose: Array,
    evidence: FitSums,
) -> float:
    """Set pose and evidence to the best pose; return the inlier share."""
    pose[:] = best
    normal_equations(submap, features, pose, match.narrow, match.step, evidence)
    return float(evidence.sums[1] / max(evidence.sums[0], 1.0))
