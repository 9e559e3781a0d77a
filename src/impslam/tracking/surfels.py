"""Prepare sweeps for matching: points thinned along the beams, with the normals of their surfaces."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Scans
from impslam.geometry.kernels import kernel, plain
from impslam.types import Array, Ints, Mask

MIN_NEIGHBOURS = 3  # beams on either side of a fitted normal, at least
WINDOW = 0.15  # m on either side of it: long compared with the noise of a beam, 1 to 3 cm
MIN_SURFACE_POINTS = 2 * MIN_NEIGHBOURS + 1  # points without a gap that show a surface's direction


class Surfels(NamedTuple):
    """The points of m sweeps, in base_link at the middle of each.

    Attributes
    ----------
    rows : (n, 6) x, y, the unit normal, 1 on a straight surface (else 0: a lone point), and 1 if it belongs
        to enough points without a gap to show a surface (else 0)
    starts : (m + 1,) those of sweep k are `rows[starts[k] : starts[k + 1]]`
    """

    rows: Array
    starts: Ints


def prepare(scans: Scans, spacing: float) -> Surfels:
    """Return the surfels of sweeps; points nearer than `spacing` m to the last one kept are left out."""
    starts = np.zeros(len(scans.stamps) + 1, np.int64)
    rows = np.empty((int(scans.valid.sum()), 6))
    valid = np.ascontiguousarray(scans.valid)
    count = _prepare(plain(scans.points), valid, gaps(scans), spacing, rows, starts)
    return Surfels(rows[:count], starts)


def gaps(scans: Scans) -> Array:
    """Return the largest distance between neighbours on one surface, (m,) m.

    It is three times the spacing of beams at the sweep's median range, plus 5 cm; 0 without valid beams.
    """
    m, n = scans.ranges.shape
    if n < 2:
        return np.zeros(m)
    spacing = abs(float(scans.angles[-1] - scans.angles[0])) / (n - 1)
    ranges, xy = np.sort(np.where(scans.valid, scans.ranges, np.inf), axis=1), scans.valid.sum(1)
    row, some = np.arange(m), np.maximum(xy, 1)
    median = 0.5 * (ranges[row, (some - 1) // 2] + ranges[row, some // 2])
    median[xy == 0] = 0.0
    return np.where(xy > 0, 0.05 + 3.0 * spacing * median, 0.0)


@kernel
def _prepare(
    points: Array, valid: Mask, gap: Array, spacing: float, rows: Array, starts: Ints
) -> int:
    """Fill `rows` and `starts` of `Surfels` from points (m, n, 2); return the number of rows."""
    xy = np.empty((points.shape[1], 2))
    count = 0
    for k in range(len(points)):
        n = 0
        for i in range(points.shape[1]):
            if valid[k, i]:
                xy[n, 0], xy[n, 1] = points[k, i, 0], points[k, i, 1]
                n += 1
        begin, last = 0, -1
        while begin < n:
            end = begin + 1
            while end < n and _distance2(xy[end - 1], xy[end]) < gap[k] ** 2:
                end += 1
            for i in range(begin, end):
                if last < 0 or _distance2(xy[last], xy[i]) >= spacing**2:
                    _fill_row(rows[count], xy, i, begin, end)
                    count += 1
                    last = i
            begin = end
        starts[k + 1] = count
    return count


@kernel
def _distance2(a: Array, b: Array) -> float:
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)


@kernel
def _fill_row(row: Array, points: Array, i: int, begin: int, end: int) -> None:
    """Fill the row of point i, which has no gap to its neighbours from `begin` to `end`.

    A straight surface needs three neighbours, and less than a fifth of the scatter along it across it.
    The normal is the eigenvector of the smaller eigenvalue of the scatter.
    """
    x, y = points[i, 0], points[i, 1]
    row[0], row[1], row[2], row[3], row[4] = x, y, 0.0, 1.0, 0.0
    row[5] = 1.0 if end - begin >= MIN_SURFACE_POINTS else 0.0
    low, high = i, i
    while low > begin and (
        i - low < MIN_NEIGHBOURS or _distance2(points[i], points[low - 1]) < WINDOW**2
    ):
        low -= 1
    while high < end - 1 and (
        high - i < MIN_NEIGHBOURS or _distance2(points[i], points[high + 1]) < WINDOW**2
    ):
        high += 1
    if high - low < 3:
        return
    sx = sy = xx = xy = yy = 0.0
    for k in range(low, high + 1):
        dx, dy = points[k, 0] - x, points[k, 1] - y
        sx, sy = sx + dx, sy + dy
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    n = high - low + 1
    xx, xy, yy = xx - sx * sx / n, xy - sx * sy / n, yy - sy * sy / n
    mid, across = 0.5 * (xx + yy), 0.5 * (xx - yy)
    half = math.sqrt(across * across + xy * xy)
    ax, ay = (half + across, xy) if across >= 0.0 else (xy, half - across)
    length = math.sqrt(ax * ax + ay * ay)
    if length > 0.0:
        row[2], row[3] = -ay / length, ax / length
        row[4] = 1.0 if mid - half < 0.04 * (mid + half) else 0.0


@kernel
def thin(rows: Array, spacing: float, surfaces_only: bool) -> Array:
    """Return the rows at least `spacing` m from the last one kept.

    With `surfaces_only`, leave out points too few together to show a surface: the far end of a grazed
    wall consists of such points, and moves with the robot.
    """
    out, count = np.empty_like(rows), 0
    for i in range(len(rows)):
        if surfaces_only and rows[i, 5] == 0.0:
            continue
        if count == 0 or _distance2(rows[i], out[count - 1]) >= spacing**2:
            out[count] = rows[i]
            count += 1
    return out[:count]
