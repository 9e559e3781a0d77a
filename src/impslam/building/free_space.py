"""Where beams went through what other scans showed.

A place on a landmark is seen through from a keyframe if every beam toward it ends well behind it.
Beams that end before it say nothing: something stands in between.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.maps.grid import PlacedScans
from impslam.types import Array, Ints

BEARINGS = 720  # half a degree: as fine as the beams of most lidars
_SECTORS = 40  # of 9 degrees, for a first look
_REACH = 8.0  # m: beyond, neighbouring beams are some 10 cm apart, and poses a degree off count
_BESIDE = 2  # bearings to each side that are looked at: one beam at least of a lidar of 1 degree
_STEEP = 0.2  # cosine of 78 deg: at a flatter incidence a beam beside a wall seems to go through


class Profile(NamedTuple):
    """Ranges of k scans by bearing.

    Attributes
    ----------
    lasers : (k, 3) x, y in map, and the heading of base_link
    nearest : (k, BEARINGS) float32 m, the shortest beam by its bearing in base_link; 0 if there is none
    farthest : (k, _SECTORS) m, the longest of these in a sector and just beside it
    """

    lasers: Array
    nearest: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    farthest: Array


@kernel
def profile(scans: PlacedScans) -> Profile:
    """Return the scans by bearing."""
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
            for b in range(sector * each - _BESIDE - 1, (sector + 1) * each + _BESIDE + 1):
                farthest[i, sector] = max(farthest[i, sector], nearest[i, b % BEARINGS])
    return Profile(lasers, nearest, farthest)


@kernel
def _bearing(seen: Profile, k: int, dx: float, dy: float) -> float:
    """Return a bearing from base_link of scan k in turns, above 1."""
    turns: float = (math.atan2(dy, dx) - seen.lasers[k, 2]) / (2.0 * math.pi) + 2.0
    return turns


@kernel
def _hidden(seen: Profile, k: int, begin: Array, end: Array, margin: float) -> bool:
    """Tell whether no beam of scan k ends behind a line between two places: most are in other rooms."""
    dx, dy = begin[0] - seen.lasers[k, 0], begin[1] - seen.lasers[k, 1]
    ux, uy = end[0] - begin[0], end[1] - begin[1]
    length2 = ux * ux + uy * uy
    s = min(max(-(dx * ux + dy * uy) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    least = math.hypot(dx + s * ux, dy + s * uy) + margin
    one, two = _bearing(seen, k, dx, dy), _bearing(seen, k, dx + ux, dy + uy)
    two -= round(two - one)  # a line spans less than half a turn
    first, last = int(min(one, two) * _SECTORS), int(max(one, two) * _SECTORS)
    for sector in range(first, last + 1):  # noqa: SIM110  kernels know no any()
        if seen.farthest[k, sector % _SECTORS] > least:
            return False
    return True


@kernel
def _through(
    seen: Profile, k: int, place: Array, normal: Array, margin: float, width: float
) -> bool:
    """Tell whether all beams of scan k toward a place end behind it."""
    dx, dy = place[0] - seen.lasers[k, 0], place[1] - seen.lasers[k, 1]
    square = dx * dx + dy * dy
    if square > _REACH * _REACH or square < margin * margin:
        return False
    distance = math.sqrt(square)
    steep = 1.0
    if not math.isnan(normal[0]):
        steep = abs(dx * normal[0] + dy * normal[1]) / distance
        if steep < _STEEP:
            return False
    middle, some = int(_bearing(seen, k, dx, dy) * BEARINGS), False
    half = _BESIDE + int(width / distance / (2.0 * math.pi) * BEARINGS)
    for b in range(middle - half, middle + half + 1):
        end = seen.nearest[k, b % BEARINGS]
        if end > 0.0:
            some = True
            if (end - distance) * steep <= margin:
                return False
    return some


@kernel
def seen_through(
    seen: Profile, places: Array, normals: Array, starts: Ints, margin: float, width: float
) -> Ints:
    """Return how many scans saw through each place.

    Parameters
    ----------
    places, normals : (p, 2) m in map, and the normal of the line there, NaN for points
    starts : (L + 1,) the places of landmark g are `places[starts[g] : starts[g + 1]]`, in a row
    margin : m, a beam that ends so far behind a place has gone through it
    width : m, beams that pass a place within this must all go through
    """
    out = np.zeros(len(places), np.int64)
    for g in range(len(starts) - 1):
        i, j = starts[g], starts[g + 1]
        x, y = 0.5 * (places[i] + places[j - 1])
        far = _REACH + 0.5 * math.hypot(
            places[j - 1, 0] - places[i, 0], places[j - 1, 1] - places[i, 1]
        )
        for k in range(len(seen.lasers)):
            dx, dy = x - seen.lasers[k, 0], y - seen.lasers[k, 1]
            near = dx * dx + dy * dy < far * far
            if near and not _hidden(seen, k, places[i], places[j - 1], margin):
                for p in range(i, j):
                    if _through(seen, k, places[p], normals[p], margin, width):
                        out[p] += 1
    return out
