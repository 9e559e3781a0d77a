"""Compiled loops of `scan_pairs`: nearest points, and their distances from lines."""

from __future__ import annotations

import math
from typing import NamedTuple

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

MIN_FACING = 0.9
"""Cosine between the normals of a pair of points."""
ROUGHNESS = 0.005
"""m: unevenness of surfaces (skirting, frames, fabric), which matters for grazing beams."""
_NEIGHBOURS, _RADIUS, _FACING = 4, 0.25, 0.95
"""Neighbours on either side, their distance in m, and cosine between normals, for smoothing."""


class IndexedSurface(NamedTuple):
    """A surface with its points sorted.

    Attributes
    ----------
    points, normals : (n, 2)
    sorted_points : (n, 2) in the order of x
    rows : (n,) of these in `points`
    """

    points: Array
    normals: Array
    sorted_points: Array
    rows: Ints


@kernel
def smooth_along(points: Array, normals: Array, out: Array) -> float:
    """Fill `out` (n, 2) with points (n, 2) in beam order, smoothed along their surface.

    Each moves along its normal to the mean of the lines through its neighbours. Return the mean number of
    points in these means; 1 if there are none.
    """
    n, everything = len(points), 0
    for i in range(n):
        off, count = 0.0, 1
        for step in range(1, _NEIGHBOURS + 1):
            for j in (i - step, i + step):
                if j < 0 or j >= n:
                    continue
                x, y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                mx, my = normals[j, 0], normals[j, 1]
                facing = normals[i, 0] * mx + normals[i, 1] * my
                if facing > _FACING and math.hypot(x, y) < _RADIUS:
                    off += 0.5 * ((normals[i, 0] + mx) * x + (normals[i, 1] + my) * y)
                    count += 1
        for axis in range(2):
            out[i, axis] = points[i, axis] + off / count * normals[i, axis]
        everything += count
    return everything / n if n else 1.0


@kernel
def find_misfit(
    a: IndexedSurface,
    b: IndexedSurface,
    pose: Array,
    radius: float,
    noise: tuple[float, float],
    out: Array,
) -> int:
    """Fill rows of out (n + m, 10) with the misfit of pairs of points, and return how many.

    A row is the distance of a point of b from the line of one of a, divided by its standard deviation;
    its derivatives by x, y and yaw of the pose and by an offset of all ranges; the distance in m; and the
    errors of the derivatives if both normals have independent errors of the size of their difference.
    Points are paired with their nearest neighbours in both directions: they are denser close to the lidar,
    so a nearest neighbour is more often a closer point measured too long, and pairing in one direction
    alone would bias ranges by some sigma^2 / r.
    """
    c, s, count = math.cos(pose[2]), math.sin(pose[2]), 0
    for i in range(len(b.points)):
        x, y = b.points[i, 0], b.points[i, 1]
        k = _nearest_row(c * x - s * y + pose[0], s * x + c * y + pose[1], a.sorted_points, radius)
        if k >= 0:
            count += _fill_row(a, b, (a.rows[k], i), (c, s), pose, noise, out[count])
    for j in range(len(a.points)):
        x, y = a.points[j, 0] - pose[0], a.points[j, 1] - pose[1]
        k = _nearest_row(c * x + s * y, c * y - s * x, b.sorted_points, radius)
        if k >= 0:
            count += _fill_row(a, b, (j, b.rows[k]), (c, s), pose, noise, out[count])
    return count


@kernel
def _fill_row(
    a: IndexedSurface,
    b: IndexedSurface,
    rows: tuple[int, int],
    turn: tuple[float, float],
    pose: Array,
    noise: tuple[float, float],
    out: Array,
) -> int:
    """Fill e, its derivatives, the distance and the errors of derivatives, (10,), of a pair.

    Returns 0 if its normals differ, else 1.
    """
    (j, i), (c, s) = rows, turn
    mx, my = c * b.normals[i, 0] - s * b.normals[i, 1], s * b.normals[i, 0] + c * b.normals[i, 1]
    if mx * a.normals[j, 0] + my * a.normals[j, 1] <= MIN_FACING:
        return 0
    rx, ry = c * b.points[i, 0] - s * b.points[i, 1], s * b.points[i, 0] + c * b.points[i, 1]
    px, py = a.points[j, 0], a.points[j, 1]
    nx, ny = mx + a.normals[j, 0], my + a.normals[j, 1]
    length = math.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    far_b, far_a = math.hypot(rx, ry), math.hypot(px, py)
    along_b, along_a = (nx * rx + ny * ry) / far_b, (nx * px + ny * py) / far_a
    of_b, of_a = (noise[0] + noise[1] * far_b) * along_b, (noise[0] + noise[1] * far_a) * along_a
    sigma = math.hypot(math.hypot(of_b, of_a), ROUGHNESS)
    off = nx * (rx + pose[0] - px) + ny * (ry + pose[1] - py)
    out[0], out[1], out[2] = off / sigma, nx / sigma, ny / sigma
    out[3], out[4], out[5] = (ny * rx - nx * ry) / sigma, (along_b - along_a) / sigma, off
    # The mean of two normals is off by half of their difference, rms, in the direction (-ny, nx).
    tilt = 0.5 * (mx * a.normals[j, 1] - my * a.normals[j, 0])
    aside = (nx * ry - ny * rx) / far_b - (nx * py - ny * px) / far_a
    out[6], out[7], out[8] = (
        -ny * tilt / sigma,
        nx * tilt / sigma,
        (nx * rx + ny * ry) * tilt / sigma,
    )
    out[9] = aside * tilt / sigma
    return 1


@kernel
def find_nearest(points: Array, others: Array, radius: float, found: Ints) -> None:
    """Fill `found` (k,) with the rows of others, sorted by x, nearest to points (k, 2); else -1."""
    for i in range(len(points)):
        found[i] = _nearest_row(points[i, 0], points[i, 1], others, radius)


@kernel
def _nearest_row(x: float, y: float, others: Array, radius: float) -> int:
    """Return the row of others, sorted by x, nearest to a point within `radius`, else -1.

    Importing k-d trees takes 0.2 s.
    """
    m, least, found = len(others), radius * radius, -1
    low, high = 0, m
    while low < high:
        middle = (low + high) // 2
        if others[middle, 0] < x:
            low = middle + 1
        else:
            high = middle
    for step in (-1, 1):
        j = low if step > 0 else low - 1
        while 0 <= j < m and (others[j, 0] - x) ** 2 < least:
            square = (others[j, 0] - x) ** 2 + (others[j, 1] - y) ** 2
            if square < least:
                least, found = square, j
            j += step
    return found
