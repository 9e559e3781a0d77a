"""How well pairs of scans fit each other, with the lidar's motion during each sweep undone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from impslam.calibration.lidar_path import LidarPath, deskewed
from impslam.calibration.scan_pairs import Surface, align, sweep_surface
from impslam.columns import Columns
from impslam.geometry.se2 import between, transform
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Ints

NEAR, MAX_MISFIT = 0.3, 0.1
"""m between points of one surface, and m from its line at which a point's distance is clipped: it is likely
on another surface."""


def pair_misfits(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, pairs: Ints) -> Array:
    """Return (k,) m, the mean distance of points from lines between the scans of pairs (k, 2) of rows.

    Scans are aligned first; nan for those that do not match.
    """
    rows = np.unique(pairs)
    surfaces = [
        sweep_surface(some, k)
        for some in deskewed(lidar, scans, path, rows)
        for k in range(len(some.stamps))
    ]
    of = dict(zip(rows.tolist(), surfaces, strict=True))
    noise = lidar.sigma, lidar.sigma_per_m
    guesses = between(path.poses[pairs[:, 0]], path.poses[pairs[:, 1]])
    return np.array(
        [
            _misfit(of[a], of[b], guess, noise)
            for (a, b), guess in zip(pairs.tolist(), guesses, strict=True)
        ]
    )


def _misfit(a: Surface, b: Surface, guess: Array, noise: tuple[float, float]) -> float:
    found = align(a, b, guess, noise)
    if found is None:
        return math.nan
    points = transform(found.T_a_b, b.points)
    apart, nearest = cKDTree(a.points).query(points, distance_upper_bound=NEAR)
    near = np.isfinite(apart)
    offset = points[near] - a.points[nearest[near]]
    distances = np.abs((offset * a.normals[nearest[near]]).sum(axis=1))
    return float(np.minimum(distances, MAX_MISFIT).mean())
