"""Verification of an alignment of two submaps, in both directions.

A point on a surface of the other submap supports the alignment. One well inside the free space of the
other's scans contradicts it. One that the other submap has not seen has no effect: counting it against
would reject true places that were seen from another side. Neither has a single point that scans of its own
submap contradict: such things are often missed.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple, TypeAlias

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import compose
from impslam.recognition.free_ranges import BEARINGS, Floats
from impslam.recognition.submap import Submap
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import MIN_NORMAL_COSINE, SurfaceMap, surfel_at
from impslam.types import Array, Ints, Mask

MATCH_DISTANCE = 0.15
"""m to the nearest surface: three cells; poses within a submap are off by 5 cm."""
END_MARGIN = 0.3  # m before and behind the end of a beam: neither free nor hidden
MIN_RANGE = 0.3  # m: bearings of closer points are meaningless
SAMPLE = 250  # points tested against free space: standard error of the share 0.03
REFERENCE_SCANS, QUERY_SCANS = 12, 8  # maximum number of scans used for free space
SCAN_RADIUS, POINT_RADIUS = 10.0, 15.0  # m around the query, of scans and points used

STRONG_SHARE, WEAK_SHARE = 0.8, 0.65
"""Minimum shares of agreeing points, among those that match or contradict."""
MIN_MATCHED = 0.35  # of the query's points
MIN_SEEN = 60  # points of the reference that the query's scans have seen


class ClosureStrength(IntEnum):
    """The strength of support; a weak closure needs others that agree."""

    REFUSED = 0
    WEAK = 1
    STRONG = 2


class Support(NamedTuple):
    """The evidence of two submaps on their alignment.

    Attributes
    ----------
    matched : share of the query's points on surfaces of the reference: their overlap
    query : accuracy: share of matches among its points that match or are contradicted
    reference : the same for the reference's points in the query's scans
    seen : approximate number of the reference's points seen by the query's scans
    """

    matched: float
    query: float
    reference: float
    seen: int

    @property
    def agreement(self) -> float:
        """The lesser accuracy of the two submaps."""
        return min(self.query, self.reference)

    @property
    def size(self) -> float:
        """The common area, relative to the least in which a closure can be strong."""
        return min(self.matched / MIN_MATCHED, self.seen / MIN_SEEN)


def judge(support: Support, overlap: float = MIN_MATCHED) -> ClosureStrength:
    """Return the verdict on support.

    With an `overlap` below `MIN_MATCHED`, submaps with less common area are accepted, but as weak ones, and
    only if free space agrees as for a strong one.
    """
    if support.size < overlap / MIN_MATCHED:
        return ClosureStrength.REFUSED
    is_large = support.size >= 1.0
    if support.agreement >= STRONG_SHARE:
        return ClosureStrength.STRONG if is_large else ClosureStrength.WEAK
    if is_large and support.agreement >= WEAK_SHARE:
        return ClosureStrength.WEAK
    return ClosureStrength.REFUSED


_Scans: TypeAlias = tuple[Array, Floats]
"""The vantages (n, 3) of some scans, and their free ranges (n, `BEARINGS`)."""


class _Evidence(NamedTuple):
    """Numbers of points that support or contradict an alignment.

    Attributes
    ----------
    matched, contradicted : of the query's points, those on surfaces and in free space of the reference
    missed : of the query's points, those that its own scans often miss; they are not contradicted
    confirmed, refuted : of a sample of the reference's points, those that the query's scans see, and in
        their free space
    lost : of that sample, those that the reference's own scans often miss; they are not refuted
    sample : size of that sample; `step` points of the reference for each
    """

    matched: int
    contradicted: int
    missed: int
    confirmed: int
    refuted: int
    lost: int
    sample: int
    step: int


def verify(known: SurfaceMap, reference: Submap, query: Submap, pose: Array) -> Support:
    """Return the support for the query's pose (3,) in the reference, whose surface map is `known`."""
    n = _evidence(known, reference, query, pose)
    return Support(
        n.matched / max(len(query.features), 1),
        n.matched / max(n.matched + n.contradicted, 1),
        n.confirmed / max(n.confirmed + n.refuted, 1),
        (n.confirmed + n.refuted) * n.step,
    )


def share_in_free_space(known: SurfaceMap, reference: Submap, query: Submap, pose: Array) -> float:
    """Return the larger of the two shares of points that are in the free space of the other submap.

    `pose` (3,) is that of the query in the reference.
    """
    n = _evidence(known, reference, query, pose)
    return max(n.contradicted / max(len(query.features), 1), n.refuted / max(n.sample, 1))


def excess_in_free_space(known: SurfaceMap, reference: Submap, query: Submap, pose: Array) -> float:
    """Return by how much either submap contradicts the other more than itself, as a share of its points.

    `pose` (3,) is that of the query in the reference.

    Scans of either miss things such as chair legs. Some of these are missed by the other's scans only, but
    no more than by those of its own submap, which has as many.
    """
    n = _evidence(known, reference, query, pose)
    return max(
        (n.contradicted - n.missed) / max(len(query.features), 1),
        (n.refuted - n.lost) / max(n.sample, 1),
    )


def _evidence(known: SurfaceMap, reference: Submap, query: Submap, pose: Array) -> _Evidence:
    """Return the evidence for the query's pose (3,) in the reference, whose surface map is `known`."""
    reference_scans = _nearest_scans(reference, pose, REFERENCE_SCANS)
    query_scans = _nearest_scans(query, np.zeros(3), QUERY_SCANS)
    query_scans = query_scans._replace(vantages=compose(pose, query_scans.vantages))
    x, y = reference.features[:, 0] - pose[0], reference.features[:, 1] - pose[1]
    close = np.flatnonzero(x * x + y * y < POINT_RADIUS * POINT_RADIUS)
    near = np.ascontiguousarray(reference.features[close[:: max(1, len(close) // SAMPLE)]])
    step = max(1, len(close) // SAMPLE)
    counts = np.zeros(6, np.int64)
    _count_evidence(
        known,
        query.features,
        pose,
        near,
        (reference_scans.vantages, reference_scans.free),
        (query_scans.vantages, query_scans.free),
        counts,
    )
    matched, contradicted, missed, confirmed, refuted, lost = (int(count) for count in counts)
    return _Evidence(matched, contradicted, missed, confirmed, refuted, lost, len(near), step)


def _nearest_scans(submap: Submap, position: Array, limit: int) -> Submap:
    """Return a submap with at most `limit` of its scans, evenly chosen among those near a position."""
    x, y = submap.vantages[:, 0] - position[0], submap.vantages[:, 1] - position[1]
    close = np.flatnonzero(x * x + y * y < SCAN_RADIUS * SCAN_RADIUS)
    close = close[:: max(1, math.ceil(len(close) / limit))]
    return Submap(submap.features, submap.vantages[close], submap.free[close])


@kernel
def _count_evidence(
    known: SurfaceMap,
    features: Features,
    pose: Array,
    points: Features,
    reference: _Scans,
    query: _Scans,
    counts: Ints,
) -> None:
    """Fill `counts` (6,) as in `_Evidence`.

    `features` are the points of the query, `points` those of the reference; the scans of both are in the
    frame of the reference.
    """
    moved = np.empty((len(features), 2))
    matched = np.empty(len(features), np.bool_)
    counts[0] = _match(known, features, pose, moved, matched)
    step = max(1, len(features) // SAMPLE)
    for i in range(0, len(features), step):
        x, y = moved[i, 0], moved[i, 1]
        if _is_often_missed(x, y, features[i], query):
            counts[2] += step
        elif not matched[i] and evidence_at(x, y, reference[0], reference[1]) < 0:
            counts[1] += step
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        evidence = evidence_at(x, y, query[0], query[1])
        is_missed = _is_often_missed(x, y, points[i], reference)
        counts[3] += evidence > 0
        counts[4] += evidence < 0 and not is_missed
        counts[5] += is_missed


@kernel
def _is_often_missed(x: float, y: float, feature: Floats, own: _Scans) -> bool:
    """Return whether a point is on no surface, and in the free space of scans of its own submap.

    Beams pass between chair legs, and people walk on. Other scans of the same place contradict such points,
    too. Walls that contradict each other within a submap do count: the robot was carried meanwhile.
    """
    is_single = feature[2] == 0.0 and feature[3] == 0.0
    return bool(is_single and evidence_at(x, y, own[0], own[1]) < 0)


@kernel
def _match(known: SurfaceMap, features: Features, pose: Array, moved: Array, matched: Mask) -> int:
    """Transform features (n,) by a pose, mark those on a surface of their direction; return the number."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    count = 0
    for i in range(len(features)):
        x = pose[0] + c * features[i, 0] - s * features[i, 1]
        y = pose[1] + s * features[i, 0] + c * features[i, 1]
        moved[i, 0], moved[i, 1], matched[i] = x, y, False
        k = surfel_at(known, x, y)
        if k < 0:
            continue
        surfel = known.surfels[k]
        along = c * (features[i, 2] * surfel[2] + features[i, 3] * surfel[3])
        along += s * (features[i, 2] * surfel[3] - features[i, 3] * surfel[2])
        are_known = features[i, 4] > 0.0 and surfel[5] > 0.0
        # Normals without weight are inaccurate, but still on the lidar's side.
        if along < (MIN_NORMAL_COSINE if are_known else -MIN_NORMAL_COSINE):
            continue
        matched[i] = (x - surfel[0]) ** 2 + (y - surfel[1]) ** 2 < MATCH_DISTANCE * MATCH_DISTANCE
        count += matched[i]
    return count


@kernel
def evidence_at(x: float, y: float, vantages: Array, free: Floats) -> int:
    """Return -1 for a point well inside the free space of any scan, 1 near ends of beams, 0 if unseen.

    `vantages` (n, 3) are the poses of the scans, m, m, rad.
    """
    evidence = 0
    for k in range(len(vantages)):
        dx, dy = x - vantages[k, 0], y - vantages[k, 1]
        r = math.sqrt(dx * dx + dy * dy)
        if r < MIN_RANGE:
            continue
        bearing = wrap_in_kernel(math.atan2(dy, dx) - vantages[k, 2])
        b = int((bearing + math.pi) * (BEARINGS / (2.0 * math.pi))) % BEARINGS
        end = min(free[k, b], free[k, (b + 1) % BEARINGS], free[k, b - 1])
        if end <= 0.0:
            continue
        if r < end - END_MARGIN:
            return -1
        if r < end + END_MARGIN:
            evidence = 1
    return evidence
