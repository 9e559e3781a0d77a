"""Score observations of labelled scans: found, repeated, of other things, false, and their errors.

An observation is assigned to a thing if more than half of its beams hit it and it is within the gates
below, which are as wide as the coarsest extractor needs. Each landmark is found once, by the observation
with the most of its beams.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impslam.errors import ShapeError
from impslam.geometry.angles import wrap
from impslam.geometry.circles import fit_circle
from impslam.geometry.lines import fit_line
from impslam.studies.bounds import bound, circle_jacobian, wall_jacobian
from impslam.studies.corridor_truth import MAX_WALL_TURN
from impslam.studies.labelled_scans import LabelledScan, Seen
from impslam.types import Array, Ints, Observation, Scan

MAX_DISTANCE = 0.1
"""m from an observation to the thing (for a wall, at the middle of its visible part)."""
RADIUS_TOLERANCE = 0.01
"""Relative difference up to which an assumed radius is correct."""


class Counts(NamedTuple):
    """Counts of observations of a scan.

    Attributes
    ----------
    visible : landmarks of which enough is visible
    found : number of these that were observed
    again : further observations of the same ones
    other : observations of existing things that are no landmarks or hardly visible
    false : observations of nothing that exists
    whole, whole_found : visible and found landmarks that are visible from edge to edge; cylinders only
    """

    visible: int
    found: int
    again: int
    other: int
    false: int
    whole: int = 0
    whole_found: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A visible landmark's observation against the truth.

    Attributes
    ----------
    error : (2,) of z, observed less true
    R, bound : (2, 2) covariance by the extractor, and the Cramér-Rao bound
    radial : m, error of a centre along the line of sight; NaN for walls
    radius_error, radius_bound : m and m^2; NaN for walls, and if the radius is assumed
    beams : number of beams that truly hit it
    used : share of these in the observation
    own_excess : squared error over the bound of those alone; NaN if they do not determine it
    """

    error: Array
    R: Array
    bound: Array
    radial: float
    radius_error: float
    radius_bound: float
    beams: int
    used: float
    own_excess: float


def score_scan(
    labelled: LabelledScan,
    kind: str,
    observations: Sequence[Observation],
    radius: float | None = None,
) -> tuple[Counts, list[Detection]]:
    """Return the counts of a scan, and the errors of found landmarks, for observations of one kind.

    `radius` is the radius that the extractor assumes for every cylinder, None if it measures it. A cylinder
    of another radius counts as found, but is left out of the errors.
    """
    best: dict[int, tuple[int, Observation]] = {}
    again = other = false = 0
    for o in observations:
        which = _observed_thing(labelled, o)
        if which is None:
            false += 1
        elif not labelled.seen[which].visible:
            other += 1
        else:
            support = len(np.intersect1d(o.beams, labelled.seen[which].beams))
            again += which in best
            if which not in best or support > best[which][0]:
                best[which] = support, o
    visible = [s for s in labelled.seen if s.visible and s.kind == kind]
    whole = sum(s.whole for s in visible), sum(labelled.seen[which].whole for which in best)
    found = [
        detection_error(labelled, labelled.seen[which], o, radius)
        for which, (_, o) in best.items()
        if radius is None or abs(labelled.seen[which].radius / radius - 1.0) <= RADIUS_TOLERANCE
    ]
    return Counts(len(visible), len(best), again, other, false, *whole), found


def _observed_thing(labelled: LabelledScan, o: Observation) -> int | None:
    """Return the index of the nearest thing that an observation can be assigned to."""
    fitting = [
        (_distance(o, seen), which)
        for which, seen in enumerate(labelled.seen)
        if seen.kind == o.kind and _is_of(o, seen)
    ]
    return min(fitting)[1] if fitting else None


def _is_of(o: Observation, seen: Seen) -> bool:
    if len(o.beams) and 2 * np.count_nonzero(np.isin(o.beams, seen.beams)) <= len(o.beams):
        return False
    turned = o.kind == "wall" and abs(wrap(float(o.z[1] - seen.z[1]))) > MAX_WALL_TURN
    return _distance(o, seen) <= MAX_DISTANCE and not turned


def _distance(o: Observation, seen: Seen) -> float:
    """Return the distance of an observation from a thing, in m."""
    if o.kind != "wall":
        return float(np.hypot(*(o.z - seen.z)))
    normal = np.array([math.cos(o.z[1]), math.sin(o.z[1])])
    return abs(float(normal @ seen.ends.mean(axis=0) - o.z[0]))


def detection_error(
    labelled: LabelledScan, seen: Seen, o: Observation, radius: float | None
) -> Detection:
    """Return an observation's error, with the bound for all beams that hit the landmark."""
    error = o.z - seen.z
    if o.kind == "wall":
        error[1] = wrap(float(error[1]))
    radial = radius_error = radius_bound = math.nan
    best = _bound(labelled, seen, seen.beams, radius)
    if o.kind != "wall":
        sight = seen.z - labelled.scan.laser[:2]
        radial = float(error @ sight / np.hypot(*sight))
        if radius is None:
            radius_error = o.attributes.get("radius", math.nan) - seen.radius
            radius_bound = float(best[2, 2])
    mine = np.isin(seen.beams, o.beams)
    own = _bound(labelled, seen, seen.beams[mine], radius)[:2, :2]
    excess = float(error @ np.linalg.solve(own, error)) if np.isfinite(own).all() else math.nan
    return Detection(
        error,
        o.R,
        best[:2, :2],
        radial,
        radius_error,
        radius_bound,
        len(seen.beams),
        float(mine.mean()),
        excess,
    )


def _bound(labelled: LabelledScan, seen: Seen, beams: Ints, radius: float | None) -> Array:
    """Return the bound for z, and for the radius if it is unknown, from some beams."""
    rays, sigmas = (labelled.origins[beams], labelled.directions[beams]), labelled.sigmas[beams]
    if seen.kind == "wall":
        return bound(wall_jacobian(seen.z, *rays), sigmas, labelled.bias)
    jacobian = circle_jacobian(np.array([*seen.z, seen.radius]), *rays)
    return bound(jacobian if radius is None else jacobian[:, :2], sigmas, labelled.bias)


def known_association(labelled: LabelledScan, kind: str) -> list[Observation]:
    """Return the fits to all beams that truly hit each visible landmark: the best possible result."""
    shown = [seen for seen in labelled.seen if seen.visible and seen.kind == kind]
    fit = _line if kind == "wall" else _circle
    return [o for o in (fit(labelled.scan, seen) for seen in shown) if o is not None]


def _line(scan: Scan, seen: Seen) -> Observation | None:
    beams = seen.beams
    fit = fit_line(scan.points[beams], scan.directions[beams], scan.sigmas[beams])
    shared = scan.bias * fit.bias_jacobian
    rho, alpha, R = fit.rho, fit.alpha, fit.covariance + np.outer(shared, shared)
    if scan.laser[:2] @ [math.cos(alpha), math.sin(alpha)] > rho:
        rho, alpha, R = -rho, wrap(alpha + math.pi), R * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return Observation("wall", np.array([rho, alpha]), R, beams, seen.ends)


def _circle(scan: Scan, seen: Seen) -> Observation | None:
    beams = seen.beams
    try:
        fit = fit_circle(scan.points[beams], scan.directions[beams], scan.sigmas[beams])
    except ShapeError:  # a few noisy points at one side of it
        return None
    shared = scan.bias * fit.bias_jacobian
    R = (fit.covariance + np.outer(shared, shared))[:2, :2]
    return Observation("cylinder", fit.centre, R, beams, None, {"radius": fit.radius})
