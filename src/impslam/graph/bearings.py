"""Scans sorted by bearing around their lidar, for nearest-neighbour search.

Occluding points have the same bearing, so only neighbours in bearing need to be searched (Censi 2008, the
search for correspondences along the beams). Points are sorted into bins of bearings, and a search proceeds
from bin to bin on both sides until no farther ray can be nearer. The result does not depend on the order of
beams, their start angle, the mount of the lidar or its field of view.

Bearings are measured along the sides of a square (|x| + |y| = 1) instead of in radians, which is also
monotonic and needs no arc tangent.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

BINS = 128  # a power of two; 1.6 to 3.6 degrees each: a few of the features of a wall, which are 4 cm apart


class ScanFeatures(NamedTuple):
    """Features of k scans, one after the other.

    Attributes
    ----------
    features : (p, 5) in base_link; see `Features`
    starts : (k + 1,) rows of scan i are starts[i] to starts[i + 1]
    lasers : (k, 2) m, position of the lidar in base_link
    """

    features: Features
    starts: Ints
    lasers: Array


class Fans(NamedTuple):
    """Scans whose features are sorted by bearing.

    Attributes
    ----------
    scans : the features of each scan in order of their bins
    table : (k, BINS + 1) features of bin b of scan i are rows table[i, b] to table[i, b + 1]
    rays : (BINS, 2) unit vectors at the lower end of each bin
    """

    scans: ScanFeatures
    table: Ints
    rays: Array


@kernel
def bearing_bin(x: float, y: float) -> int:
    """Return the bin of the bearing of a point, m from the lidar."""
    along = abs(x) + abs(y)
    if along == 0.0:
        return 0
    side = 1.0 - x / along if y >= 0.0 else 3.0 + x / along
    return min(int(side * (BINS // 4)), BINS - 1)


@kernel
def sort_by_bearing(scans: ScanFeatures) -> Fans:
    """Return the scans sorted by bearing; features of one bin keep their order."""
    features, starts, lasers = scans.features, scans.starts, scans.lasers
    k = len(starts) - 1
    out = np.empty_like(features)
    bins = np.empty(len(features), np.int64)
    table = np.zeros((k, BINS + 1), np.int64)
    place = np.empty(BINS, np.int64)
    for i in range(k):
        for p in range(starts[i], starts[i + 1]):
            bins[p] = bearing_bin(features[p, 0] - lasers[i, 0], features[p, 1] - lasers[i, 1])
            table[i, bins[p] + 1] += 1
        table[i, 0] = starts[i]
        for b in range(BINS):
            table[i, b + 1] += table[i, b]
            place[b] = table[i, b]
        for p in range(starts[i], starts[i + 1]):
            out[place[bins[p]]] = features[p]
            place[bins[p]] += 1
    return Fans(ScanFeatures(out, starts, lasers), table, _rays())


@kernel
def _rays() -> Array:
    rays = np.empty((BINS, 2))
    for b in range(BINS):
        side = b / (BINS // 4)
        x = 1.0 - side if side <= 2.0 else side - 3.0
        y = 1.0 - abs(x) if side <= 2.0 else abs(x) - 1.0
        length = math.sqrt(x * x + y * y)
        rays[b, 0], rays[b, 1] = x / length, y / length
    return rays


@kernel
def nearest_feature(fans: Fans, i: int, x: float, y: float, radius: float) -> int:
    """Return the row of the feature of scan i nearest to a point x, y m in base_link.

    -1 if none is within `radius` m.
    """
    features, table, rays = fans.scans.features, fans.table, fans.rays
    qx, qy = x - fans.scans.lasers[i, 0], y - fans.scans.lasers[i, 1]
    home = bearing_bin(qx, qy)
    best, found = radius * radius, -1
    for side in (1, -1):
        for step in range(0 if side > 0 else 1, BINS // 2 + 1):
            b = (home + side * step) & (BINS - 1)
            if step > 0:  # minimum distance of points in this bin, or in a farther one
                edge = b if side > 0 else (b + 1) & (BINS - 1)
                across = qx * rays[edge, 1] - qy * rays[edge, 0]
                ahead = qx * rays[edge, 0] + qy * rays[edge, 1] > 0.0
                if (across * across if ahead else qx * qx + qy * qy) >= best:
                    break
            for p in range(table[i, b], table[i, b + 1]):
                dx, dy = features[p, 0] - x, features[p, 1] - y
                if dx * dx + dy * dy < best:
                    best, found = dx * dx + dy * dy, p
    return found
