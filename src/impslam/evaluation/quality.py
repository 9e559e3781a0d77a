"""Map quality without truth: how well scans of the same place agree.

Pairs of keyframes that show the same place are compared in both directions. A surface point of one scan
matches a surface of the other with a similar normal; its error is the distance to that surface along the
normal. It is contradicted if beams of the other scan pass through its position: its error is then the
distance to the nearest surface with a similar normal (a doubled wall), or `MAX_ERROR` if there is none.
Points hidden from the other scan do not count.

Measures of the point cloud alone, such as mean map entropy and mean plane variance (Razlaw et al. 2015), do
not use free space: to them a doubled wall is two thin walls; the same is true for MOM (Kornilova & Ferrer
2021). Counts of cells, corners and enclosed areas (Filatov et al. 2017) grow with the observed area. Free
space observed by one scan contradicts a doubled wall directly (for point clouds: Bogoslavskyi & Stachniss
2017).

The result does not depend on the number of keyframes, of beams, or of visits to a place: keyframes and
points are thinned to a fixed spacing, and errors are averaged by the place they were observed from. A map
that is bent as a whole, but whose scans agree, cannot be distinguished from a straight one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from impslam.building.free_space import BEARINGS, Profile, profile
from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel, plain
from impslam.graph.bearings import Fans, ScanFeatures, nearest_feature, sort_by_bearing
from impslam.graph.overlaps import Nearness, overlaps
from impslam.map import Keyframes, Map
from impslam.maps.grid import PlacedScans
from impslam.surfaces.features import Features, Sampling, find_features
from impslam.types import Array, Ints, Mask

MAX_ERROR = 0.6  # m: surfaces farther apart are two walls, not one doubled wall
MATCH_DISTANCE = 0.1  # m: three sigma of a point with a noise of 1 to 3 cm
FREE_MARGIN = 0.15
"""m before the end of a beam up to which space is free: MATCH_DISTANCE at 45 degrees."""
MIN_FACING = 0.7  # cosine of 45 degrees: normals farther apart belong to two surfaces
KEYFRAME_SPACING = 0.4  # m, or rad, between keyframes: closer ones show the same
POINT_SPACING = 0.1  # m between points: dense beams close to a wall repeat its errors
CELL = 1.0  # m, side of the cells with equal weight, however often they were visited
PASS_DISTANCE = 8.0  # m driven between two passes of a place: a room and back
_NEIGHBOURS = 2  # bearings of half a degree: a thin object between two beams is not seen through
_MIN_RANGE = 0.3  # m around a lidar within which bearings are meaningless


@dataclass(frozen=True, slots=True)
class Quality:
    """Agreement of the scans of a map; lower is better. NaN if unknown.

    Attributes
    ----------
    disagreement : m, the mean of the following two, or the one that is known
    within, between : m, mean error of a point seen in the same pass of a place, and in another one
    thickness : m, RMS distance of matched points from their surface
    contradicted : share of compared points that the other scan saw through
    doubled : share of compared points that are contradicted and have a parallel surface nearby
    revisited : share of the area that was seen in two passes
    """

    disagreement: float
    within: float
    between: float
    thickness: float
    contradicted: float
    doubled: float
    revisited: float

    def figures(self) -> dict[str, float]:
        """Return the values by their names in JSON files, with units; shares have none."""
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
    """Return how well the scans of a map agree with each other; see the module docstring."""
    keyframes = _spaced(known.keyframes)
    lasers = profile(keyframes)
    poses = keyframes.poses
    pairs = overlaps(lasers.lasers, Nearness(turn=math.pi, pass_distance=PASS_DISTANCE))
    step = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    travel = np.concatenate([np.zeros(1), np.cumsum(step)])
    again = np.abs(travel[pairs[:, 0]] - travel[pairs[:, 1]]) >= PASS_DISTANCE
    both = np.ascontiguousarray(np.concatenate([pairs, pairs[:, ::-1]]))
    counts = _Counts(*np.zeros((5, len(both))))
    if len(both):
        _compare(_fans(keyframes), lasers, poses, both, counts)
    return _summary(counts, _cells(poses[both[:, 1]]), np.concatenate([again, again]))


def _spaced(keyframes: Keyframes) -> PlacedScans:
    """Return the placed keyframes with points, about `KEYFRAME_SPACING` apart along the path."""
    counts = np.diff(keyframes.starts)
    usable = keyframes.placed & (counts > 0) & np.isfinite(keyframes.poses).all(axis=1)
    rows = np.flatnonzero(usable)
    poses = keyframes.poses[rows]
    dx, dy, turn = np.diff(poses, axis=0).T
    moved = np.hypot(dx, dy) + np.abs(wrap(turn))
    length = np.concatenate([np.zeros(min(1, len(rows))), np.cumsum(moved)])
    rows = rows[np.unique(np.floor(length / KEYFRAME_SPACING), return_index=True)[1]]
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts[rows])])
    used = np.zeros(len(counts), np.bool_)
    used[rows] = True
    points = keyframes.points[np.repeat(used, counts)]
    return PlacedScans(plain(keyframes.poses[rows]), keyframes.origins[rows], starts, points)


def _fans(scans: PlacedScans) -> Fans:
    """Return the points of the scans with their normals, sorted by bearing."""
    features = np.empty((len(scans.points), 5), np.float32)
    starts = _find(scans, features)
    return sort_by_bearing(ScanFeatures(features[: starts[-1]].copy(), starts, scans.origins))


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
        sampling = Sampling(spacing, POINT_SPACING, smooth=False)
        count = find_features(points, ranges > 0.0, ranges, origins, sampling, rest)
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
            if distance < MATCH_DISTANCE:
                counts.matched[q] += 1.0
                counts.square[q] += distance * distance
            elif _seen_through(seen, fans, i, (x, y, nx, ny)):
                counts.contradicted[q] += 1.0
                counts.doubled[q] += distance < MAX_ERROR
            else:
                continue
            counts.error[q] += distance


@kernel
def _distance(fans: Fans, i: int, point: tuple[float, float, float, float]) -> float:
    """Return the distance of a point from the surface of scan i with a similar normal."""
    x, y, nx, ny = point
    features = fans.scans.features
    k = nearest_feature(fans, i, x, y, MAX_ERROR)
    if k < 0 or features[k, 4] == 0.0 or nx * features[k, 2] + ny * features[k, 3] < MIN_FACING:
        return MAX_ERROR
    across: float = abs(
        features[k, 2] * (x - features[k, 0]) + features[k, 3] * (y - features[k, 1])
    )
    return across


@kernel
def _seen_through(
    seen: Profile, fans: Fans, i: int, point: tuple[float, float, float, float]
) -> bool:
    """Return whether beams of scan i on both sides of a point pass it from its front."""
    x, y, nx, ny = point
    dx, dy = x - fans.scans.lasers[i, 0], y - fans.scans.lasers[i, 1]
    distance = math.sqrt(dx * dx + dy * dy)
    if distance < _MIN_RANGE or nx * dx + ny * dy >= 0.0:
        return False
    middle = int((math.atan2(dy, dx) / (2.0 * math.pi) + 1.0) * BEARINGS)
    beams = 0
    for b in range(middle - _NEIGHBOURS, middle + _NEIGHBOURS + 1):
        end = seen.nearest[i, b % BEARINGS]
        beams += end > 0.0
        if 0.0 < end < distance + FREE_MARGIN:
            return False
    return beams > 1


def _cells(poses: Array) -> Ints:
    """Return the number (m,) of the cell of each pose, counted from 0 without gaps."""
    cells = np.floor(poses[:, :2] / CELL)
    return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)


def _summary(counts: _Counts, cells: Ints, again: Mask) -> Quality:
    """Return the means over cells, separately for pairs of one pass and of different passes."""
    compared = counts.matched + counts.contradicted
    everything = np.ones(len(compared), np.bool_)
    within, _ = _mean(counts.error, compared, cells, ~again)
    between, revisited = _mean(counts.error, compared, cells, again)
    square, _ = _mean(counts.square, counts.matched, cells, everything)
    contradicted, all_cells = _mean(counts.contradicted, compared, cells, everything)
    doubled, _ = _mean(counts.doubled, compared, cells, everything)
    known = [part for part in (within, between) if not math.isnan(part)]
    return Quality(
        disagreement=sum(known) / len(known) if known else math.nan,
        within=within,
        between=between,
        thickness=math.sqrt(square),
        contradicted=contradicted,
        doubled=doubled,
        revisited=revisited / all_cells if all_cells else math.nan,
    )


def _mean(values: Array, weights: Array, cells: Ints, chosen: Mask) -> tuple[float, int]:
    """Return the mean over cells of the ratio of summed values and weights, and the number of cells.

    The mean of no cells is NaN.
    """
    total = np.bincount(cells, values * chosen)
    weight = np.bincount(cells, weights * chosen)
    used = weight > 0.0
    count = int(used.sum())
    return (float((total[used] / weight[used]).mean()) if count else math.nan), count
