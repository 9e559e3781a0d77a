"""Split a scan into straight pieces, at corners and bends (compiled)."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

_MIN_CORNER = 4.5
"""standard deviations off the chord: exceeded by 1 of 500 straight segments of 300 points."""
_MIN_BEND_GAIN = 25.0  # chi-square of three parameters (a second line, and its start): p = 1.5e-5
_MIN_BEND_HEIGHT = 3.0  # in units of `flatness`: a smaller bend is the wall's own shape
MIN_PIECE = 4  # points: two define a line, two more confirm it


@kernel
def _farthest(
    points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int
) -> tuple[int, float]:
    """Return the point of [i, j) farthest from the chord, and its distance in standard deviations."""
    cx, cy = points[j - 1, 0] - points[i, 0], points[j - 1, 1] - points[i, 1]
    length = math.hypot(cx, cy)
    if length == 0.0:
        return i, 0.0
    tx, ty = cx / length, cy / length
    best, where = 0.0, i
    for k in range(i + 1, j - 1):
        distance = abs(tx * (points[k, 1] - points[i, 1]) - ty * (points[k, 0] - points[i, 0]))
        if distance > best:
            best, where = distance, k
    along = (
        tx * (points[where, 0] - points[i, 0]) + ty * (points[where, 1] - points[i, 1])
    ) / length
    variance = variance_across(beams, variances, flat2, where, tx, ty)
    variance += (1.0 - along) ** 2 * variance_across(beams, variances, flat2, i, tx, ty)
    variance += along**2 * variance_across(beams, variances, flat2, j - 1, tx, ty)
    return where, best / math.sqrt(variance)


@kernel
def variance_across(
    beams: Array, variances: Array, flat2: float, k: int, tx: float, ty: float
) -> float:
    """Return the variance of a point across a line along (tx, ty)."""
    cosine = tx * beams[k, 1] - ty * beams[k, 0]
    variance: float = variances[k] * (cosine * cosine + 1e-6) + flat2
    return variance


@kernel
def _misfit(sums: Array, a: int, b: int) -> float:
    """Return the squared residuals of the regression line through points [a, b)."""
    w = sums[b, 0] - sums[a, 0]
    x = (sums[b, 1] - sums[a, 1]) / w
    y = (sums[b, 2] - sums[a, 2]) / w
    xx = sums[b, 3] - sums[a, 3] - w * x * x
    xy = sums[b, 4] - sums[a, 4] - w * x * y
    yy = sums[b, 5] - sums[a, 5] - w * y * y
    misfit: float = yy - xy * xy / xx if xx > 0.0 else yy
    return misfit


@kernel
def _sums(points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int) -> Array:
    """Return running sums of w, x, y, xx, xy, yy in the frame of the chord of [i, j)."""
    cx, cy = points[j - 1, 0] - points[i, 0], points[j - 1, 1] - points[i, 1]
    length = max(math.hypot(cx, cy), 1e-9)
    tx, ty = cx / length, cy / length
    sums = np.zeros((j - i + 1, 6))
    for k in range(i, j):
        dx, dy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
        x, y = tx * dx + ty * dy, tx * dy - ty * dx
        w = 1.0 / variance_across(beams, variances, flat2, k, tx, ty)
        row = k - i
        sums[row + 1, 0] = sums[row, 0] + w
        sums[row + 1, 1] = sums[row, 1] + w * x
        sums[row + 1, 2] = sums[row, 2] + w * y
        sums[row + 1, 3] = sums[row, 3] + w * x * x
        sums[row + 1, 4] = sums[row, 4] + w * x * y
        sums[row + 1, 5] = sums[row, 5] + w * y * y
    return sums


@kernel
def _bend(
    points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int
) -> tuple[int, float, float]:
    """Return the best split of [i, j) into two lines, the gain in chi2, and the gain per weight."""
    sums = _sums(points, beams, variances, flat2, i, j)
    n = j - i
    one = _misfit(sums, 0, n)
    best, where = one, 0
    for k in range(MIN_PIECE, n - MIN_PIECE + 1):
        two = _misfit(sums, 0, k) + _misfit(sums, k, n)
        if two < best:
            best, where = two, k
    # Mean square removed by the second line, in m^2: the square of the bend's height.
    return i + where, one - best, (one - best) / max(sums[n, 0], 1e-300)


@kernel
def _split_at(points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int) -> int:
    """Return where to split [i, j), or i if it is straight."""
    where, distance = _farthest(points, beams, variances, flat2, i, j)
    if distance > _MIN_CORNER:
        return where
    if j - i >= 2 * MIN_PIECE:
        where, gain, height2 = _bend(points, beams, variances, flat2, i, j)
        # A hat of height h has the mean square h^2 / 12 about its best line.
        if gain > _MIN_BEND_GAIN and 12.0 * height2 > _MIN_BEND_HEIGHT * _MIN_BEND_HEIGHT * flat2:
            return where
    return i


@kernel
def split(points: Array, beams: Array, variances: Array, starts: Ints, flat2: float) -> Ints:
    """Return the straight pieces of all segments: (p, 3) first and past-the-last point, segment."""
    n = len(points)
    pieces = np.empty((n, 3), np.int64)
    stack = np.empty((n + 1, 2), np.int64)
    count = 0
    for s in range(len(starts) - 1):
        stack[0, 0], stack[0, 1] = starts[s], starts[s + 1]
        top = 1
        while top > 0:
            top -= 1
            i, j = stack[top, 0], stack[top, 1]
            if j - i < MIN_PIECE:
                continue
            k = _split_at(points, beams, variances, flat2, i, j)
            if k == i:
                pieces[count, 0], pieces[count, 1], pieces[count, 2] = i, j, s
                count += 1
            else:  # the first part is handled first, so that pieces come out in order
                stack[top, 0], stack[top, 1] = k, j
                stack[top + 1, 0], stack[top + 1, 1] = i, k
                top += 2
    return pieces[:count]
