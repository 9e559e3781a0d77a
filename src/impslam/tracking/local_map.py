"""The points that a robot saw on its last metres, with normals, in cells for quick look-up.

Points stand in a ring in the order in which they came, so that the oldest are forgotten without a
search. Cells are square and repeat every `SIDE` of them: points of places so far apart share one,
which costs time and changes nothing, because each distance is looked at.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

ROOM = 1 << 15
"""Points at most; beyond, the oldest are forgotten. At 5 cm they line 1.6 km of walls."""
SIDE = 256
"""Cells to a side until they repeat, a power of two: 64 m with cells of 25 cm."""


class LocalMap(NamedTuple):
    """Where the robot is, and the points it knows there. Kernels change all of it in place.

    Attributes
    ----------
    rows : (ROOM, 6) x, y, the normal, 1 on a straight surface, and the way (m) at which it came
    older, newer : (ROOM,) the neighbours of a point in its cell's chain, -1 at the ends
    cells : (SIDE * SIDE,) the newest point of each cell, -1 in an empty one
    ring : (2,) number of points forgotten, and of points that ever came
    pose : (3,) of base_link
    way : (1,) m, of it so far
    cell : m, a cell's side
    """

    rows: Array
    older: npt.NDArray[np.int32]
    newer: npt.NDArray[np.int32]
    cells: npt.NDArray[np.int32]
    ring: Ints
    pose: Array
    way: Array
    cell: float


def empty_map(cell: float) -> LocalMap:
    """Return a map without points, the robot at its origin."""
    return LocalMap(
        np.empty((ROOM, 6)),
        np.empty(ROOM, np.int32),
        np.empty(ROOM, np.int32),
        np.full(SIDE * SIDE, -1, np.int32),
        np.zeros(2, np.int64),
        np.zeros(3),
        np.zeros(1),
        cell,
    )


@kernel
def size(known: LocalMap) -> int:
    """Return the number of points."""
    return int(known.ring[1] - known.ring[0])


@kernel
def nearest(x: float, y: float, limit: float, known: LocalMap, hint: int) -> int:
    """Return the row of the nearest point within `limit` m, or -1.

    `hint` is the row of a point that is perhaps near, or -1: it spares looking farther than there.
    """
    best, found = limit * limit, -1
    if hint >= 0:
        best, found = _nearer(x, y, hint, known, best, found)
    i, j = math.floor(x / known.cell), math.floor(y / known.cell)
    best, found = _search(x, y, i, j, known, best, found)
    reach = math.sqrt(best)
    low, high = math.floor((y - reach) / known.cell), math.floor((y + reach) / known.cell)
    for a in range(math.floor((x - reach) / known.cell), math.floor((x + reach) / known.cell) + 1):
        for b in range(low, high + 1):
            if a != i or b != j:
                best, found = _search(x, y, a, b, known, best, found)
    return found


@kernel
def _search(
    x: float, y: float, i: int, j: int, known: LocalMap, best: float, found: int
) -> tuple[float, int]:
    """Return the least squared distance, and to which point, after looking into cell (i, j)."""
    row = known.cells[_place(i, j)]
    while row >= 0:
        best, found = _nearer(x, y, row, known, best, found)
        row = known.older[row]
    return best, found


@kernel
def _nearer(
    x: float, y: float, row: int, known: LocalMap, best: float, found: int
) -> tuple[float, int]:
    dx, dy = known.rows[row, 0] - x, known.rows[row, 1] - y
    apart2 = dx * dx + dy * dy
    return (apart2, row) if apart2 < best else (best, found)


@kernel
def _place(i: int, j: int) -> int:
    return (i & (SIDE - 1)) * SIDE + (j & (SIDE - 1))


@kernel
def add(known: LocalMap, points: Array, spacing: float, memory: float) -> None:
    """Enter the points that are new here, `Surfels.rows` of a sweep; forget those seen too long ago."""
    while size(known) and known.rows[known.ring[0] % ROOM, 5] <= known.way[0] - memory:
        _forget(known)
    c, s = math.cos(known.pose[2]), math.sin(known.pose[2])
    for k in range(len(points)):
        x = known.pose[0] + c * points[k, 0] - s * points[k, 1]
        y = known.pose[1] + s * points[k, 0] + c * points[k, 1]
        if nearest(x, y, spacing, known, -1) >= 0:
            continue
        if size(known) == ROOM:
            _forget(known)
        row = known.ring[1] % ROOM
        known.rows[row, 0], known.rows[row, 1] = x, y
        known.rows[row, 2] = c * points[k, 2] - s * points[k, 3]
        known.rows[row, 3] = s * points[k, 2] + c * points[k, 3]
        known.rows[row, 4], known.rows[row, 5] = points[k, 4], known.way[0]
        cell = _place(math.floor(x / known.cell), math.floor(y / known.cell))
        newest = known.cells[cell]
        known.older[row], known.newer[row], known.cells[cell] = newest, -1, row
        if newest >= 0:
            known.newer[newest] = row
        known.ring[1] += 1


@kernel
def _forget(known: LocalMap) -> None:
    """Take the oldest point out, which is the last one of its cell's chain."""
    row = known.ring[0] % ROOM
    newer = known.newer[row]
    if newer >= 0:
        known.older[newer] = -1
    else:
        x, y = known.rows[row, 0], known.rows[row, 1]
        known.cells[_place(math.floor(x / known.cell), math.floor(y / known.cell))] = -1
    known.ring[0] += 1
