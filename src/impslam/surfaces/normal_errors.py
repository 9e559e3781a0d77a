"""The information that errors of normals add to a match: the scan seems to show motion along its walls."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.surfaces.features import NORMAL_RADIUS, Features
from impslam.surfaces.surface_map import CELL, MIN_NORMAL_COSINE, SurfaceMap, min_cell, surfel_of
from impslam.types import Array

BESIDE = 0.1  # m: a surface continues where a surfel is as near as this
MAX_SIGMAS = 3.0  # of the angle between two normals: beyond, they differ by more than their errors


@kernel
def spurious_information(
    surface_map: SurfaceMap, features: Features, pose: Array, scale: float
) -> Array:
    """Return the part of `FitSums.H` (3, 3) at a fitted pose (3,) that errors of normals cause.

    `scale` is that of the robust kernel, m. A normal n that is off by a small angle a gives its point the
    row n + a t, with t along the surface. That adds E[a^2] t t^T to the information: noise of regressors
    (Fuller 1987). a^2 is half of the squared angle between the normals of point and surfel. Edges and
    small objects do show motion along their surfaces: `MAX_SIGMAS` limits the angles of edges, and objects
    smaller than 2 `NORMAL_RADIUS` are left out.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    nearest, beside = min_cell(scale), min_cell(BESIDE / 3.0)
    S, rows, sines = np.zeros((3, 3)), np.empty((len(features), 3)), np.empty(len(features))
    weights, count = np.empty(len(features)), 0
    for i in range(len(features)):
        rx = c * features[i, 0] - s * features[i, 1]
        ry = s * features[i, 0] + c * features[i, 1]
        cell, weight = _cell_at(surface_map, pose[0] + rx, pose[1] + ry), float(features[i, 4])
        if cell < nearest:
            continue
        surfel = surface_map.surfels[surfel_of(cell)]
        x, y, nx, ny, weight = surfel[0], surfel[1], surfel[2], surfel[3], weight * surfel[5]
        fx = c * features[i, 2] - s * features[i, 3]
        fy = s * features[i, 2] + c * features[i, 3]
        if not weight > 0.0 or nx * fx + ny * fy < MIN_NORMAL_COSINE:
            continue
        dx, dy = -NORMAL_RADIUS * ny, NORMAL_RADIUS * nx
        if _cell_at(surface_map, x - dx, y - dy) < beside:
            continue
        if _cell_at(surface_map, x + dx, y + dy) < beside:
            continue
        e = nx * (pose[0] + rx - x) + ny * (pose[1] + ry - y)
        weights[count] = 0.5 * weight / (1.0 + (e / scale) ** 2) ** 2
        sines[count] = abs(fx * ny - fy * nx)
        rows[count, 0], rows[count, 1], rows[count, 2] = -ny, nx, nx * rx + ny * ry
        count += 1
    if count == 0:
        return S
    most = MAX_SIGMAS / 0.6745 * np.median(sines[:count])
    for i in range(count):
        weight = weights[i] * min(sines[i], most) ** 2
        for j in range(3):
            for k in range(3):
                S[j, k] += weight * rows[i, j] * rows[i, k]
    return S


@kernel
def _cell_at(surface_map: SurfaceMap, x: float, y: float) -> int:
    """Return the value of the cell at a position in m, 0 outside the grid."""
    height, width = surface_map.cells.shape
    u, v = (x - surface_map.corner[0]) / CELL, (y - surface_map.corner[1]) / CELL
    if not (0.0 <= u < width and 0.0 <= v < height):
        return 0
    return int(surface_map.cells[int(v), int(u)])
