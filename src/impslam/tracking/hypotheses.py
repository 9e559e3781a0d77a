"""Chooses between poses where a scan fits more than one: after a slip, along a corridor, at a ramp.

Alignment finds the pose next to where it begins. Where that is doubtful it begins elsewhere, too, and
the pose that is most probable is kept: by the points that fit, and by what odometry says, which is
right within its noise or, seldom, slipped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import Alignment, Evidence, SurfaceMap, align, normal_equations
from impslam.types import Array

STEADY = (0.1, 0.2)
"""m, rad: a match farther from constant velocity may have jumped to a wrong minimum, or odometry have
slipped. Indoor robots change their speed by less than 2 m/s^2 and 5 rad/s^2, over 0.2 s at most."""
SLIPS = 1e-3
"""Share of matches before which odometry slipped: ten in an hour. A slip is anything within 0.5 m and
0.5 rad, a volume of 1 m^2 rad."""
HEADINGS, TURN, STEP = 9, 0.06, 0.25
"""Number of headings, rad between them, and m of the offsets that are tried around each prediction."""
SEARCH_PRIOR = 0.1
"""How much the prior counts while other poses are sought, relative to a match."""


class Prediction(NamedTuple):
    """Where the robot may be before its scan is matched; poses (3,) along the axes of the map.

    Attributes
    ----------
    pose : by odometry
    information : (3,) of it, 1/m^2, 1/m^2, 1/rad^2, unless odometry slipped
    last, going : at the newest match, and from there at constant velocity
    usual : the inlier share of scans before
    """

    pose: Array
    information: Array
    last: Array
    going: Array
    usual: float


@kernel
def is_steady(pose: Array, predicted: Prediction) -> bool:
    """Tell whether a pose is as far as a robot gets that does not brake or jump."""
    d = np.empty(3)
    between(predicted.going, pose, d)
    return bool(math.hypot(d[0], d[1]) <= STEADY[0] and abs(d[2]) <= STEADY[1])


@kernel
def chi2_of(pose: Array, predicted: Prediction) -> float:
    """Return the squared Mahalanobis distance of a pose (3,) from odometry."""
    ex, ey = pose[0] - predicted.pose[0], pose[1] - predicted.pose[1]
    et = wrap_in_kernel(pose[2] - predicted.pose[2])
    a = predicted.information
    return float(a[0] * ex * ex + a[1] * ey * ey + a[2] * et * et)


@kernel
def cost(pose: Array, predicted: Prediction, match: Alignment, evidence: Evidence) -> float:
    """Return the negative logarithm of a pose's probability, but for a constant.

    Of points it is what alignment makes least, Geman-McClure's cost: the squared scale for each that is
    no inlier. But those that fitted no better in scans before tell nothing: they show what the map does
    not yet, and fewest of them are left where a robot did not move. Of odometry it is that of a prior
    with heavy tails, or of a slip.
    """
    missing = max(predicted.usual * evidence.sums[0] - evidence.sums[1], 0.0)
    points = match.information * match.narrow**2 * missing
    within = match.slack2 * math.log(1.0 + chi2_of(pose, predicted) / match.slack2)
    a = predicted.information
    density = math.log(a[0] * a[1] * a[2] / (2.0 * math.pi) ** 3) - 2.0 * math.log(SLIPS)
    return float(0.5 * (points + min(within, max(density, 0.0))))


@kernel
def reconsider(
    known: SurfaceMap,
    features: Features,
    predicted: Prediction,
    match: Alignment,
    pose: Array,
    evidence: Evidence,
) -> float:
    """Align also from the last pose and from that at constant velocity; keep what costs least.

    `pose` (3,) and `evidence` are those of an alignment from odometry's pose and change in place;
    returned is the inlier share.
    """
    best, other = pose.copy(), np.empty(3)
    prior = predicted.information * SEARCH_PRIOR
    least = cost(pose, predicted, match, evidence)
    for start in (predicted.going, predicted.last):
        other[:] = start
        align(known, features, other, prior, match, evidence)
        costs = cost(other, predicted, match, evidence)
        if costs < least:
            best[:], least = other, costs
    return _settle(known, features, best, match, pose, evidence)


@kernel
def search(
    known: SurfaceMap,
    features: Features,
    predicted: Prediction,
    match: Alignment,
    pose: Array,
    evidence: Evidence,
) -> float:
    """Align from poses around all predictions; keep a clear best; see `reconsider`.

    Its inlier share has to be well above that so far and near the usual one; and it must not cost more,
    which asks for a clearer best the better odometry is.
    """
    coarse = Alignment(8, 0.25, 0.1, match.information, max(1, len(features) // 60), match.slack2)
    fine = Alignment(4, 0.1, match.narrow, match.information, match.step, match.slack2)
    prior, costs = predicted.information * SEARCH_PRIOR, cost(pose, predicted, match, evidence)
    best, other = pose.copy(), np.empty(3)
    enough = max(evidence.sums[1] / max(evidence.sums[0], 1.0) + 0.2, 0.6 * predicted.usual, 0.5)
    for start in (predicted.pose, predicted.last, predicted.going):
        for turn in range(-(HEADINGS // 2), HEADINGS // 2 + 1):
            for offset in range(5):
                other[:] = start
                other[2] += turn * TURN
                other[0] += STEP * ((offset == 1) - (offset == 2))
                other[1] += STEP * ((offset == 3) - (offset == 4))
                align(known, features, other, prior, coarse, evidence)
                found = align(known, features, other, prior, fine, evidence)
                if found > enough:
                    best[:], enough = other, found
    normal_equations(known, features, best, match.narrow, match.step, evidence)
    if cost(best, predicted, match, evidence) > costs:
        best[:] = pose
    return _settle(known, features, best, match, pose, evidence)


@kernel
def _settle(
    known: SurfaceMap,
    features: Features,
    best: Array,
    match: Alignment,
    pose: Array,
    evidence: Evidence,
) -> float:
    """Bring pose and evidence to the best pose; return the inlier share."""
    pose[:] = best
    normal_equations(known, features, pose, match.narrow, match.step, evidence)
    return float(evidence.sums[1] / max(evidence.sums[0], 1.0))
