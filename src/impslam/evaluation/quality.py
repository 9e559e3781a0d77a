"""Map quality without truth: how well scans of the same place agree on the map.

Pairs of keyframes that look at the same place are compared both ways. A surface point of one scan
matches a surface of the other that faces the same way; its error is the distance to that surface
along the normal. It is contradicted where the other scan saw through its place: its error is then
the distance to the nearest surface that faces the same way (a doubled wall), or `FARTHEST` where
there is none. What is hidden from the other scan says nothing.

Measures of the point cloud alone, such as mean map entropy and mean plane variance (Razlaw et al.
2015), do not see free space: a wall that stands twice is two thin walls to them, and MOM
(Kornilova & Ferrer 2021) shares this. Counts of cells, corners and enclosed areas (Filatov et al.
2017) grow with the area that was seen. What one scan saw free contradicts the second wall at once
(for point clouds: Bogoslavskyi & Stachniss 2017).

Neither the number of keyframes nor that of beams, nor how often a place was passed, weighs: keyframes
and points are thinned to a fixed spacing, and the errors are averaged by the place they were seen
from. A map that is bent as a whole, and whose scans still agree, is not told from a straight one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impslam.building.free_space import BEARINGS, Profile, profile
from impslam.geometry.kernels import kernel, plain
from impslam.graph.bearings import Fans, Scans, nearest_feature, sort_by_bearing
from impslam.graph.overlaps import Nearness, overlaps
from impslam.map import Keyframes, Map
from impslam.maps.grid import PlacedScans
from impslam.surfaces.features import Features, find_features
from impslam.types import Array, Ints, Mask

FARTHEST = 0.6  # m: surfaces farther apart are two walls, not one that stands twice
NEAR = 0.1  # m: three sigma of a point, whose noise is 1 to 3 cm
BEFORE = 0.15  # m before the end of a beam and more, a place was seen through: NEAR at 45 degrees
FACING = 0.7  # cosine of 45 degrees: normals farther apart belong to two surfaces
STEP = 0.4  # m of way, or rad, between keyframes: nearer ones see the same
THIN = 0.1  # m between points: beams close to a wall repeat its errors
PLACE = 1.0  # m, side of the cells that weigh alike, however often they were passed
PASS = 8.0  # m of way between two passes of a place: a room and back
_BESIDE = 2  # bearings of half a degree: a thin thing between two beams is not seen through
_BLIND = 0.3  # m around a lidar, where bearings mean nothing


@dataclass(frozen=True, slots=True)
class Quality:
    """How well the scans of a map agree; the less, the better. NaN where nothing tells.

    Attributes
    ----------
    disagreement : m, the mean of the following two, or the one that is known
    within, between : m, mean error of a point seen in the same pass of a place, and in another one
    thickness : m, RMS distance of matched points from their surface
    contradicted : share of points, of those that tell, that lie where the other scan saw through
    doubled : share of points that are so, with a surface beside them that faces the same way
    revisited : share of the places, by area, that were seen in two passes
    """

    disagreement: float
    within: float
    between: float
    thickness: float
    contradicted: float
    doubled: float
    revisited: float

    def figures(self) -> dict[str, float]:
        """Return the values by their names in JSON files, which tell the unit; shares have none."""
        lengths = ("disagreement", "within", "between", "thickness")
        shares = ("contradicted", "doubled", "revisited")
        metres = {f"{name}_m": getattr(self, name) for name in lengths}
        return metres | {name: getattr(self, name) for name in shares}


class _Counts(NamedTuple):
    """Sums over the points of m pairs, each (m,): errors m, squared errors m^2, numbers of points."""

    error: Array
    square: Array
    matched: Array
    doubled: Array
    contradicted: Array


def quality(known: Map) -> Quality:
    """Return how well the scans of a map agree with each other, see the top of this file."""
    keyframes = _spread(known.keyframes)
    lasers = profile(keyframes)
    poses = keyframes.poses
    pairs = overlaps(lasers.lasers, Nearness(turn=math.pi, pass_distance=PASS))
    step = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    way = np.concatenate([np.zeros(1), np.cumsum(step)])
    again = np.abs(way[pairs[:, 0]] - way[pairs[:, 1]]) >= PASS
    both = np.ascontiguousarray(np.concatenate([pairs, pairs[:, ::-1]]))
    counts = _Counts(*np.zeros((5, len(both))))
    if len(both):
        _compare(_fans(keyframes), lasers, poses, both, counts)
    return _summary(counts, _places(poses[both[:, 1]]), np.concatenate([again, again]))


def _spread(keyframes: Keyframes) -> PlacedScans:
    """Return the placed keyframes that have points, at least about `STEP` apart along the drive."""
    counts = np.diff(keyframes.starts)
    usable = keyframes.placed & (counts > 0) & np.isfinite(keyframes.poses).all(axis=1)
    rows = np.flatnonzero(usable)
    poses = keyframes.poses[rows]
    moved = np.abs(np.diff(poses, axis=0))
    moved[:, 2] = np.minimum(moved[:, 2], np.abs(2.0 * math.pi - moved[:, 2]))
    length = np.concatenate([np.zeros(min(1, len(rows))), np.cumsum(moved.sum(axis=1))])
    rows = rows[np.unique(np.floor(length / STEP), return_index=True)[1]]
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts[rows])])
    used = np.zeros(len(counts), np.bool_)
    used[rows] = True
    points = keyframes.points[np.repeat(used, counts)]
    return PlacedScans(plain(keyframes.poses[rows]), keyframes.origins[rows], starts, points)


def _fans(scans: PlacedScans) -> Fans:
    """Return the points of the scans with their normals, sorted by bearing."""
    features = np.empty((len(scans.points), 5), np.float32)
    starts = _find(scans, features)
    return sort_by_bearing(Scans(features[: starts[-1]].copy(), starts, scans.origins))


@kernel
def _find(scans: PlacedScans, out: Features) -> Ints:
    """Fill `out` with the features of the scans; return where each begins, (k + 1,)."""
    starts = np.zeros(len(scans.poses) + 1, np.int64)
    for k in range(len(scans.poses)):
        points = scans.points[scans.starts[k] : scans.starts[k + 1]].astype(np.float64)
        origins = np.empty_like(points)
        origins[:] = scans.origins[k]
        offsets = points - origins
        ranges = np.sqrt(offsets[:, 0] ** 2 + offsets[:, 1] ** 2)
        turns = np.abs(np.diff(np.arctan2(offsets[:, 1], offsets[:, 0])))
        spacing = np.median(turns) if len(turns) else 0.0
        rest = out[starts[k] :]
        count = find_features(points, ranges > 0.0, ranges, origins, spacing, THIN, rest)
        starts[k + 1] = starts[k] + count
    return starts


@kernel
def _compare(fans: Fans, seen: Profile, poses: Array, pairs: Ints, counts: _Counts) -> None:
    """Fill the counts of pairs (m, 2): the points of scan j in the view of scan i."""
    features, starts = fans.scans.features, fans.scans.starts
    for q in range(len(pairs)):
        i, j = pairs[q]
        turn, ci, si = poses[j, 2] - poses[i, 2], math.cos(poses[i, 2]), math.sin(poses[i, 2])
        c, s = math.cos(turn), math.sin(turn)
        dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        x0, y0 = ci * dx + si * dy, ci * dy - si * dx
        for p in range(starts[j], starts[j + 1]):
            if features[p, 4] == 0.0:
                continue
            x = x0 + c * features[p, 0] - s * features[p, 1]
            y = y0 + s * features[p, 0] + c * features[p, 1]
            nx = c * features[p, 2] - s * features[p, 3]
            ny = s * features[p, 2] + c * features[p, 3]
            distance = _distance(fans, i, (x, y, nx, ny))
            if distance < NEAR:
                counts.matched[q] += 1.0
                counts.square[q] += distance * distance
            elif _seen_through(seen, fans, i, (x, y, nx, ny)):
                counts.contradicted[q] += 1.0
                counts.doubled[q] += distance < FARTHEST
            else:
                continue
            counts.error[q] += distance


@kernel
def _distance(fans: Fans, i: int, point: tuple[float, float, float, float]) -> float:
    """Return the distance of a point with its normal from the surface of scan i that faces its way."""
    x, y, nx, ny = point
    features = fans.scans.features
    k = nearest_feature(fans, i, x, y, FARTHEST)
    if k < 0 or features[k, 4] == 0.0 or nx * features[k, 2] + ny * features[k, 3] < FACING:
        return FARTHEST
    across: float = abs(
        features[k, 2] * (x - features[k, 0]) + features[k, 3] * (y - features[k, 1])
    )
    return across


@kernel
def _seen_through(
    seen: Profile, fans: Fans, i: int, point: tuple[float, float, float, float]
) -> bool:
    """Tell whether the beams of scan i on both sides of a point, from its front, end behind it."""
    x, y, nx, ny = point
    dx, dy = x - fans.scans.lasers[i, 0], y - fans.scans.lasers[i, 1]
    distance = math.sqrt(dx * dx + dy * dy)
    if distance < _BLIND or nx * dx + ny * dy >= 0.0:
        return False
    middle = int((math.atan2(dy, dx) / (2.0 * math.pi) + 1.0) * BEARINGS)
    beams = 0
    for b in range(middle - _BESIDE, middle + _BESIDE + 1):
        end = seen.nearest[i, b % BEARINGS]
        beams += end > 0.0
        if 0.0 < end < distance + BEFORE:
            return False
    return beams > 1


def _places(poses: Array) -> Ints:
    """Return a number (m,) of the cell of each pose, from 0 on without gaps."""
    cells = np.floor(poses[:, :2] / PLACE)
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)


def _summary(counts: _Counts, places: Ints, again: Mask) -> Quality:
    """Return the means over places, of the pairs that are of one pass and of the others."""
    told = counts.matched + counts.contradicted
    everything = np.ones(len(told), np.bool_)
    within, _ = _mean(counts.error, told, places, ~again)
    between, twice = _mean(counts.error, told, places, again)
    square, _ = _mean(counts.square, counts.matched, places, everything)
    contradicted, all_places = _mean(counts.contradicted, told, places, everything)
    doubled, _ = _mean(counts.doubled, told, places, everything)
    known = [part for part in (within, between) if not math.isnan(part)]
    return Quality(
        disagreement=sum(known) / len(known) if known else math.nan,
        within=within,
        between=between,
        thickness=math.sqrt(square),
        contradicted=contradicted,
        doubled=doubled,
        revisited=twice / all_places if all_places else math.nan,
    )


def _mean(values: Array, weights: Array, places: Ints, chosen: Mask) -> tuple[float, int]:
    """Return the mean over places of sums of values by weights, NaN of none, and how many places."""
    total = np.bincount(places, values * chosen)
    weight = np.bincount(places, weights * chosen)
    told = weight > 0.0
    count = int(told.sum())
    return (float((total[told] / weight[told]).mean()) if count else math.nan), count
