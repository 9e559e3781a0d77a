"""What speaks for an alignment of two submaps and what against it, judged both ways.

A point on a surface of the other submap speaks for the alignment. One well inside the space that the
other's scans saw free speaks against it. One where the other submap never looked tells nothing: to count
it against would refuse true places that were seen from another side.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import compose
from impslam.recognition.submap import BEARINGS, Floats, Submap
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import CELL, FACING, SurfaceMap
from impslam.types import Array, Ints, Mask

NEAR = 0.15  # m to the nearest surface: three cells of the map; the poses within a submap differ by 5 cm
INSIDE = 0.3  # m before the end of a beam, on either side of it: neither free space nor hidden
BLIND = 0.3  # m around a lidar where bearings mean nothing
SAMPLE = 250  # points tested against free space: a share to within 0.03 (binomial, one sigma)
REFERENCE_SCANS, QUERY_SCANS = 12, 8  # whose free space is used
VICINITY = 10.0  # m: only scans taken so close to the query tell of it
REACH = 15.0  # m: and so do points

STRONG_SHARE, WEAK_SHARE = 0.8, 0.65
"""Of the points that tell anything, those that agree, at least."""
MIN_MATCHED = 0.35  # of the query's points
LEAST_SEEN = 60  # points of the reference that the query's scans must have seen


class Verdict(IntEnum):
    """What support amounts to; a weak one needs other closures that agree."""

    REFUSED = 0
    WEAK = 1
    STRONG = 2


class Support(NamedTuple):
    """What two submaps say of their alignment.

    Attributes
    ----------
    matched : share of the query's points on surfaces of the reference: their overlap
    query : of its points that match or are contradicted, those that match: accuracy
    reference : the same of the reference's points in the query's scans
    seen : about how many of the reference's points the query's scans tell anything of
    """

    matched: float
    query: float
    reference: float
    seen: int

    @property
    def agreement(self) -> float:
        """The lesser accuracy: of the points that tell anything, the share that agrees."""
        return min(self.query, self.reference)


def judge(support: Support, overlap: float = MIN_MATCHED) -> Verdict:
    """Return what support amounts to.

    With an `overlap` below `MIN_MATCHED`, submaps that share less than that may agree too, but weakly,
    and free space has to agree as for a strong one.
    """
    if support.matched < overlap or support.seen < overlap / MIN_MATCHED * LEAST_SEEN:
        return Verdict.REFUSED
    much = support.matched >= MIN_MATCHED and support.seen >= LEAST_SEEN
    if support.agreement >= STRONG_SHARE:
        return Verdict.STRONG if much else Verdict.WEAK
    return Verdict.WEAK if much and support.agreement >= WEAK_SHARE else Verdict.REFUSED


def verify(known: SurfaceMap, reference: Submap, query: Submap, pose: Array) -> Support:
    """Return the support for the query's pose (3,) in the reference, whose surface map is `known`."""
    seeing = _nearest_scans(reference, pose, REFERENCE_SCANS)
    looking = _nearest_scans(query, np.zeros(3), QUERY_SCANS)
    looking = looking._replace(vantages=compose(pose, looking.vantages))
    x, y = reference.features[:, 0] - pose[0], reference.features[:, 1] - pose[1]
    close = np.flatnonzero(x * x + y * y < REACH * REACH)
    near = np.ascontiguousarray(reference.features[close[:: max(1, len(close) // SAMPLE)]])
    step = max(1, len(close) // SAMPLE)
    counts = np.zeros(4, np.int64)
    _survey(
        known,
        query.features,
        pose,
        (seeing.vantages, seeing.free),
        (near, looking.vantages, looking.free),
        counts,
    )
    matched, against, confirmed, contradicted = (int(count) for count in counts)
    return Support(
        matched / max(len(query.features), 1),
        matched / max(matched + against, 1),
        confirmed / max(confirmed + contradicted, 1),
        (confirmed + contradicted) * step,
    )


def _nearest_scans(submap: Submap, position: Array, most: int) -> Submap:
    """Return a submap with at most so many of its scans, evenly among those close to a position."""
    x, y = submap.vantages[:, 0] - position[0], submap.vantages[:, 1] - position[1]
    close = np.flatnonzero(x * x + y * y < VICINITY * VICINITY)
    close = close[:: max(1, math.ceil(len(close) / most))]
    return Submap(submap.features, submap.vantages[close], submap.free[close])


@kernel
def _survey(
    known: SurfaceMap,
    features: Features,
    pose: Array,
    seeing: tuple[Array, Floats],
    looking: tuple[Features, Array, Floats],
    counts: Ints,
) -> None:
    """Fill `counts` (4,): query points matched, contradicted; reference points confirmed, contradicted.

    `seeing` are vantages and free ranges of the reference, `looking` points of the reference with the
    vantages, in its frame, and free ranges of the query.
    """
    moved = np.empty((len(features), 2))
    matched = np.empty(len(features), np.bool_)
    counts[0] = _match(known, features, pose, moved, matched)
    step = max(1, len(features) // SAMPLE)
    for i in range(0, len(features), step):
        if not matched[i] and evidence_at(moved[i, 0], moved[i, 1], seeing[0], seeing[1]) < 0:
            counts[1] += step
    for i in range(len(looking[0])):
        held = evidence_at(looking[0][i, 0], looking[0][i, 1], looking[1], looking[2])
        if held != 0:
            counts[2 if held > 0 else 3] += 1


@kernel
def _match(known: SurfaceMap, features: Features, pose: Array, moved: Array, matched: Mask) -> int:
    """Move features (n,) to a pose, tell which lie on a surface that faces their way; return how many."""
    height, width = known.nearest.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    count = 0
    for i in range(len(features)):
        x = pose[0] + c * features[i, 0] - s * features[i, 1]
        y = pose[1] + s * features[i, 0] + c * features[i, 1]
        moved[i, 0], moved[i, 1], matched[i] = x, y, False
        u, v = (x - known.corner[0]) / CELL, (y - known.corner[1]) / CELL
        if u < 0.0 or v < 0.0 or u >= width or v >= height:
            continue
        k = known.nearest[int(v), int(u)] - 1
        if k < 0:
            continue
        surfel = known.surfels[k]
        along = c * (features[i, 2] * surfel[2] + features[i, 3] * surfel[3])
        along += s * (features[i, 2] * surfel[3] - features[i, 3] * surfel[2])
        if along < FACING and features[i, 4] > 0.0 and surfel[5] > 0.0:
            continue
        matched[i] = (x - surfel[0]) ** 2 + (y - surfel[1]) ** 2 < NEAR * NEAR
        count += matched[i]
    return count


@kernel
def evidence_at(x: float, y: float, vantages: Array, free: Floats) -> int:
    """Return -1 for a point well inside free space of any scan, 1 where beams end, 0 if unseen."""
    held = 0
    for k in range(len(vantages)):
        dx, dy = x - vantages[k, 0], y - vantages[k, 1]
        r = math.sqrt(dx * dx + dy * dy)
        if r < BLIND:
            continue
        bearing = wrap_in_kernel(math.atan2(dy, dx) - vantages[k, 2])
        b = int((bearing + math.pi) * (BEARINGS / (2.0 * math.pi))) % BEARINGS
        end = min(free[k, b], free[k, (b + 1) % BEARINGS], free[k, b - 1])
        if end <= 0.0:
            continue
        if r < end - INSIDE:
            return -1
        if r < end + INSIDE:
            held = 1
    return held
