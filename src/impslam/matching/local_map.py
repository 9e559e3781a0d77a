"""The points that a robot saw on its last metres, with normals, in cells for quick look-up."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

REACH = 3  # beams on either side that a normal is fitted to


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
        while low > 0 and i - low < REACH and _near(points, low, low - 1, gap):
            low -= 1
        while high < n - 1 and high - i < REACH and _near(points, high, high + 1, gap):
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


@kernel
def _sort_into_cells(
    points: Array, origin: Array, cell: float, nx: int, ny: int
) -> tuple[Ints, Ints]:
    """Return where each cell begins (nx * ny + 1,) in an order (n,) of the points by cell."""
    starts, order = np.zeros(nx * ny + 1, np.int64), np.empty(len(points), np.int64)
    cells = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x = int((points[i, 0] - origin[0]) / cell)
        y = int((points[i, 1] - origin[1]) / cell)
        cells[i] = x * ny + y
        starts[cells[i] + 1] += 1
    for c in range(nx * ny):
        starts[c + 1] += starts[c]
    filled = starts[:-1].copy()
    for i in range(len(points)):
        order[filled[cells[i]]] = i
        filled[cells[i]] += 1
    return starts, order


@kernel
def nearest(  # noqa: PLR0913, PLR0917  a kernel takes plain arrays
    x: float,
    y: float,
    limit: float,
    points: Array,
    starts: Ints,
    order: Ints,
    origin: Array,
    cell: float,
    shape: tuple[int, int],
) -> int:
    """Return the index of the nearest point within `limit` <= cell, or -1."""
    cx, cy = int((x - origin[0]) / cell), int((y - origin[1]) / cell)
    best, found = limit * limit, -1
    low, high = max(cy - 1, 0), min(cy + 2, shape[1])
    if low >= high:
        return -1
    for i in range(max(cx - 1, 0), min(cx + 2, shape[0])):
        row = i * shape[1]
        for k in range(starts[row + low], starts[row + high]):
            dx, dy = points[order[k], 0] - x, points[order[k], 1] - y
            if dx * dx + dy * dy < best:
                best, found = dx * dx + dy * dy, order[k]
    return found


@kernel
def _new(  # noqa: PLR0913, PLR0917  a kernel takes plain arrays
    candidates: Array,
    spacing: float,
    points: Array,
    starts: Ints,
    order: Ints,
    origin: Array,
    cell: float,
    shape: tuple[int, int],
) -> Mask:
    """Tell which candidates (n, 2) have no known point within `spacing`."""
    out = np.empty(len(candidates), np.bool_)
    for i in range(len(candidates)):
        x, y = candidates[i]
        out[i] = nearest(x, y, spacing, points, starts, order, origin, cell, shape) < 0
    return out


class LocalMap:
    """Points (n, 2), normals (n, 2) and flatness (n,) of the last `memory` metres of way."""

    def __init__(self, cell: float, spacing: float, memory: float) -> None:
        self.cell, self._spacing, self._memory = cell, spacing, memory
        self.points, self.normals = np.empty((0, 2)), np.empty((0, 2))
        self.flat = np.empty(0, np.bool_)
        self._way = np.empty(0)
        self._index()

    def add(self, points: Array, directions: Array, flat: Mask, way: float) -> None:
        """Enter the points that are new here, and forget those seen too long ago."""
        new = _new(points, self._spacing, self.points, *self.index)
        old = self._way > way - self._memory
        self.points = np.vstack([self.points[old], points[new]])
        self.normals = np.vstack([self.normals[old], directions[new]])
        self.flat = np.concatenate([self.flat[old], flat[new]])
        self._way = np.concatenate([self._way[old], np.full(int(new.sum()), way)])
        self._index()

    def _index(self) -> None:
        margin = 2.0 * self.cell
        low = self.points.min(axis=0, initial=np.inf) if len(self.points) else np.zeros(2)
        high = self.points.max(axis=0, initial=-np.inf) if len(self.points) else np.zeros(2)
        origin = np.asarray(low, dtype=np.float64) - margin
        nx, ny = (int(v) + 1 for v in (high + margin - origin) / self.cell)
        starts, order = _sort_into_cells(self.points, origin, self.cell, nx, ny)
        self.index = (starts, order, origin, self.cell, (nx, ny))
