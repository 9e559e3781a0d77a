"""Compiled loops of `scan_pairs`: nearest points, and their distances from lines."""

from __future__ import annotations

import math

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

MIN_FACING = 0.9
"""Cosine between the normals of a pair of points."""
ROUGHNESS = 0.005
"""m: unevenness of surfaces (skirting, frames, fabric), which matters for grazing beams."""


@kernel
def find_misfit(
    a: tuple[Array, Array, Array, Ints],
    b: tuple[Array, Array, Array, Ints],
    pose: Array,
    radius: float,
    noise: tuple[float, float],
    out: Array,
) -> int:
    """Fill rows of out (n + m, 6) with the distances of `scan_pairs._misfit`, and return how many.

    A surface is its points and normals (n, 2), its points sorted by x (n, 2), and the rows (n,) of these.
    Points are paired with their nearest neighbours in both directions: they are denser close to the lidar,
    so a nearest neighbour is more often a closer point measured too long, and pairing in one direction
    alone would bias ranges by some sigma^2 / r.
    """
    c, s, count = math.cos(pose[2]), math.sin(pose[2]), 0
    for i in range(len(b[0])):
        x, y = b[0][i, 0], b[0][i, 1]
        k = _nearest_row(c * x - s * y + pose[0], s * x + c * y + pose[1], a[2], radius)
        if k >= 0:
            count += _fill_row(a, b, (a[3][k], i), (c, s), pose, noise, out[count])
    for j in range(len(a[0])):
        x, y = a[0][j, 0] - pose[0], a[0][j, 1] - pose[1]
        k = _nearest_row(c * x + s * y, c * y - s * x, b[2], radius)
        if k >= 0:
            count += _fill_row(a, b, (j, b[3][k]), (c, s), pose, noise, out[count])
    return count


@kernel
def _fill_row(
    a: tuple[Array, Array, Array, Ints],
    b: tuple[Array, Array, Array, Ints],
    rows: tuple[int, int],
    turn: tuple[float, float],
    pose: Array,
    noise: tuple[float, float],
    out: Array,
) -> int:
    """Fill e, its derivatives and the distance, (6,), of a pair; return 0 if its normals differ, else 1."""
    (j, i), (c, s) = rows, turn
    mx, my = c * b[1][i, 0] - s * b[1][i, 1], s * b[1][i, 0] + c * b[1][i, 1]
    if mx * a[1][j, 0] + my * a[1][j, 1] <= MIN_FACING:
        return 0
    rx, ry = c * b[0][i, 0] - s * b[0][i, 1], s * b[0][i, 0] + c * b[0][i, 1]
    px, py = a[0][j, 0], a[0][j, 1]
    nx, ny = mx + a[1][j, 0], my + a[1][j, 1]
    length = math.hypot(nx, ny)
    nx, ny = nx / length, ny / length
    far_b, far_a = math.hypot(rx, ry), math.hypot(px, py)
    along_b, along_a = (nx * rx + ny * ry) / far_b, (nx * px + ny * py) / far_a
    of_b, of_a = (noise[0] + noise[1] * far_b) * along_b, (noise[0] + noise[1] * far_a) * along_a
    sigma = math.hypot(math.hypot(of_b, of_a), ROUGHNESS)
    off = nx * (rx + pose[0] - px) + ny * (ry + pose[1] - py)
    out[0], out[1], out[2] = off / sigma, nx / sigma, ny / sigma
    out[3], out[4], out[5] = (ny * rx - nx * ry) / sigma, (along_b - along_a) / sigma, off
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
