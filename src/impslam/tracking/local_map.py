"""The points that a robot saw on its last metres, with normals, in cells for quick look-up."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

REACH = 3  # beams on either side that a normal is fitted to at least
WINDOW = 0.15  # m on either side that it is fitted to: long against the noise of a beam, 1 to 3 cm


@kernel
def normals(points: Array, gap: float) -> tuple[Array, Mask]:
    """Return unit normals (n, 2) of points in beam order, and which lie on a straight surface.

    A surface needs three neighbours no farther apart than `gap` m, and a scatter across it of less
    than a fifth of that along it.
    """
    n = len(points)
    out, flat = np.zeros((n, 2)), np.zeros(n, np.bool_)
    for i in range(n):
        low = high = i
        while (
            low > 0
            and _near(points, low, low - 1, gap)
            and (i - low < REACH or _near(points, i, low - 1, WINDOW))
        ):
            low -= 1
        while (
            high < n - 1
            and _near(points, high, high + 1, gap)
            and (high - i < REACH or _near(points, i, high + 1, WINDOW))
        ):
            high += 1
        if high - low < 3:
            continue
        mx, my = points[low : high + 1, 0].mean(), points[low : high + 1, 1].mean()
        xx = xy = yy = 0.0
        for k in range(low, high + 1):
            dx, dy = points[k, 0] - mx, points[k, 1] - my
            xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
        mid, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        along = 0.5 * math.atan2(2.0 * xy, xx - yy)
        out[i, 0], out[i, 1] = -math.sin(along), math.cos(along)
        flat[i] = mid - half < 0.04 * (mid + half)
    return out, flat


@kernel
def _near(points: Array, a: int, b: int, gap: float) -> bool:
    return math.hypot(points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]) < gap


class Surfaces(NamedTuple):
    """Known points (n, 2), their normals (n, 2) and flatness (n,), sorted into square cells.

    The points of cell (x, y) are `order[starts[x * ny + y] : starts[x * ny + y + 1]]`.
    """

    points: Array
    normals: Array
    flat: Mask
    starts: Ints
    order: Ints
    origin: Array
    cell: float
    nx: int
    ny: int


@kernel
def _sort_into_cells(points: Array, cell: float) -> tuple[Ints, Ints, Array, int, int]:
    """Return `starts`, `order`, `origin`, `nx` and `ny` of `Surfaces` for points (n, 2)."""
    low, high = np.zeros(2), np.zeros(2)
    for i in range(len(points)):
        for axis in range(2):
            value = points[i, axis]
            low[axis] = value if i == 0 else min(low[axis], value)
            high[axis] = value if i == 0 else max(high[axis], value)
    nx, ny = int((high[0] - low[0]) / cell) + 1, int((high[1] - low[1]) / cell) + 1
    starts, order = np.zeros(nx * ny + 1, np.int64), np.empty(len(points), np.int64)
    cells = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x, y = int((points[i, 0] - low[0]) / cell), int((points[i, 1] - low[1]) / cell)
        cells[i] = x * ny + y
        starts[cells[i] + 1] += 1
    for c in range(nx * ny):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    for i in range(len(points)):
        order[filled[cells[i]]] = i
        filled[cells[i]] += 1
    return starts, order, low, nx, ny


@kernel
def nearest(x: float, y: float, limit: float, known: Surfaces) -> int:
    """Return the index of the nearest known point within `limit`, or -1."""
    dx, dy = x - known.origin[0], y - known.origin[1]
    best, found = limit * limit, -1
    low = max(math.floor((dy - limit) / known.cell), 0)
    high = min(math.floor((dy + limit) / known.cell) + 1, known.ny)
    if low >= high:
        return -1
    left = max(math.floor((dx - limit) / known.cell), 0)
    right = min(math.floor((dx + limit) / known.cell) + 1, known.nx)
    for i in range(left, right):
        for k in range(known.starts[i * known.ny + low], known.starts[i * known.ny + high]):
            j = known.order[k]
            dx, dy = known.points[j, 0] - x, known.points[j, 1] - y
            if dx * dx + dy * dy < best:
                best, found = dx * dx + dy * dy, j
    return found


@kernel
def _new(candidates: Array, spacing: float, known: Surfaces) -> Mask:
    """Tell which candidates (n, 2) have no known point within `spacing`."""
    out = np.empty(len(candidates), np.bool_)
    for i in range(len(candidates)):
        out[i] = nearest(candidates[i, 0], candidates[i, 1], spacing, known) < 0
    return out


class LocalMap:
    """The surfaces seen on the last `memory` metres of way."""

    def __init__(self, cell: float, spacing: float, memory: float) -> None:
        self._cell, self._spacing, self._memory = cell, spacing, memory
        self._way = np.empty(0)
        self.surfaces = self._sorted(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.bool_))

    def add(self, points: Array, directions: Array, flat: Mask, way: float) -> None:
        """Enter the points that are new here, and forget those seen too long ago."""
        known = self.surfaces
        new = _new(points, self._spacing, known)
        old = self._way > way - self._memory
        self._way = np.concatenate([self._way[old], np.full(int(new.sum()), way)])
        self.surfaces = self._sorted(
            np.concatenate([known.points[old], points[new]]),
            np.concatenate([known.normals[old], directions[new]]),
            np.concatenate([known.flat[old], flat[new]]),
        )

    def _sorted(self, points: Array, directions: Array, flat: Mask) -> Surfaces:
        starts, order, origin, nx, ny = _sort_into_cells(points, self._cell)
        return Surfaces(points, directions, flat, starts, order, origin, self._cell, nx, ny)
