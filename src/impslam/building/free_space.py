"""Count the scans that see through landmarks of other scans.

A keyframe sees through a point on a landmark if every beam toward it ends well behind it. Beams that end
before it carry no information: the view is blocked.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.maps.grid import PlacedScans
from impslam.types import Array, Ints

BEARINGS = 720  # half a degree: as fine as the beams of most lidars
_SECTORS = 40  # of 9 degrees, for a coarse test
_MAX_RANGE = 8.0  # m: beyond, neighbouring beams are some 10 cm apart, and heading errors matter
_NEIGHBOURS = 2  # bearings on each side: at least one beam of a lidar of 1 degree
_MIN_COSINE = 0.2  # 78 deg: at a flatter incidence, a beam beside a wall seems to pass through it


class Profile(NamedTuple):
    """Ranges of k scans by bearing.

    Attributes
    ----------
    lasers : (k, 3) x, y in map, and the heading of base_link
    nearest : (k, BEARINGS) float32 m, shortest beam by bearing in base_link; 0 for none
    farthest : (k, _SECTORS) m, longest of these in each sector and its margins
    """

    lasers: Array
    nearest: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    farthest: Array


@kernel
def profile(scans: PlacedScans) -> Profile:
    """Return the ranges of scans by bearing."""
    k = len(scans.poses)
    lasers, nearest = np.empty((k, 3)), np.zeros((k, BEARINGS), np.float32)
    farthest, each = np.zeros((k, _SECTORS)), BEARINGS // _SECTORS
    for i in range(k):
        c, s = math.cos(scans.poses[i, 2]), math.sin(scans.poses[i, 2])
        x, y = scans.origins[i]
        lasers[i, 0] = scans.poses[i, 0] + c * x - s * y
        lasers[i, 1] = scans.poses[i, 1] + s * x + c * y
        lasers[i, 2] = scans.poses[i, 2]
        for p in range(scans.starts[i], scans.starts[i + 1]):
            dx, dy = scans.points[p, 0] - x, scans.points[p, 1] - y
            b = int((math.atan2(dy, dx) / (2.0 * math.pi) + 1.0) * BEARINGS) % BEARINGS
            distance = np.float32(math.hypot(dx, dy))
            if nearest[i, b] == 0.0 or distance < nearest[i, b]:
                nearest[i, b] = distance
        for sector in range(_SECTORS):
            for b in range(sector * each - _NEIGHBOURS - 1, (sector + 1) * each + _NEIGHBOURS + 1):
                farthest[i, sector] = max(farthest[i, sector], nearest[i, b % BEARINGS])
    return Profile(lasers, nearest, farthest)


@kernel
def _bearing(seen: Profile, k: int, dx: float, dy: float) -> float:
    """Return the bearing of a direction in base_link of scan k, in turns, above 1."""
    turns: float = (math.atan2(dy, dx) - seen.lasers[k, 2]) / (2.0 * math.pi) + 2.0
    return turns


@kernel
def _hidden(seen: Profile, k: int, begin: Array, end: Array, margin: float) -> bool:
    """Return whether no beam of scan k ends behind a line segment, as for those in other rooms."""
    dx, dy = begin[0] - seen.lasers[k, 0], begin[1] - seen.lasers[k, 1]
    ux, uy = end[0] - begin[0], end[1] - begin[1]
    length2 = ux * ux + uy * uy
    s = min(max(-(dx * ux + dy * uy) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    min_range = math.hypot(dx + s * ux, dy + s * uy) + margin
    one, two = _bearing(seen, k, dx, dy), _bearing(seen, k, dx + ux, dy + uy)
    two -= round(two - one)  # a line spans less than half a turn
    first, last = int(min(one, two) * _SECTORS), int(max(one, two) * _SECTORS)
    for sector in range(first, last + 1):  # noqa: SIM110  kernels know no any()
        if seen.farthest[k, sector % _SECTORS] > min_range:
            return False
    return True


@kernel
def _passes_through(
    seen: Profile, k: int, point: Array, normal: Array, margin: float, width: float
) -> bool:
    """Return whether all beams of scan k toward a point end behind it."""
    dx, dy = point[0] - seen.lasers[k, 0], point[1] - seen.lasers[k, 1]
    square = dx * dx + dy * dy
    if square > _MAX_RANGE * _MAX_RANGE or square < margin * margin:
        return False
    distance = math.sqrt(square)
    cosine = 1.0
    if not math.isnan(normal[0]):
        cosine = abs(dx * normal[0] + dy * normal[1]) / distance
        if cosine < _MIN_COSINE:
            return False
    middle, has_beam = int(_bearing(seen, k, dx, dy) * BEARINGS), False
    half = _NEIGHBOURS + int(width / distance / (2.0 * math.pi) * BEARINGS)
    for b in range(middle - half, middle + half + 1):
        end = seen.nearest[k, b % BEARINGS]
        if end > 0.0:
            has_beam = True
            if (end - distance) * cosine <= margin:
                return False
    return has_beam


@kernel
def seen_through(
    seen: Profile, points: Array, normals: Array, starts: Ints, margin: float, width: float
) -> Ints:
    """Return the number (p,) of scans that see through each point.

    Parameters
    ----------
    points, normals : (p, 2) m in map, and the normal of the line there, NaN for point landmarks
    starts : (L + 1,) the points of landmark g are `points[starts[g] : starts[g + 1]]`, in order
    margin : m, a beam that ends so far behind a point has passed through it
    width : m, all beams within this distance of a point must pass through
    """
    out = np.zeros(len(points), np.int64)
    for g in range(len(starts) - 1):
        i, j = starts[g], starts[g + 1]
        x, y = 0.5 * (points[i] + points[j - 1])
        limit = _MAX_RANGE + 0.5 * math.hypot(
            points[j - 1, 0] - points[i, 0], points[j - 1, 1] - points[i, 1]
        )
        for k in range(len(seen.lasers)):
            dx, dy = x - seen.lasers[k, 0], y - seen.lasers[k, 1]
            is_near = dx * dx + dy * dy < limit * limit
            if is_near and not _hidden(seen, k, points[i], points[j - 1], margin):
                for p in range(i, j):
                    if _passes_through(seen, k, points[p], normals[p], margin, width):
                        out[p] += 1
    return out
