"""The points that a robot saw on its last metres, with normals, in cells for quick look-up.

Points stand in a ring in the order in which they came, so that the oldest are forgotten without a
search. Cells are square and repeat every `SIDE` of them: points of places so far apart share one,
which costs time and changes nothing, because each distance is looked at.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

Links: TypeAlias = npt.NDArray[np.int32]
ROOM = 1 << 15
"""Points at most; beyond, the oldest are forgotten. At 5 cm they line 1.6 km of walls."""
CELL = 0.125
"""m, a cell's side: a few points, of which a surface has one every 5 cm."""
SIDE = 256
"""Cells to a side until they repeat, a power of two: every 32 m."""


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
    """

    rows: Array
    older: Links
    newer: Links
    cells: Links
    ring: Ints
    pose: Array
    way: Array


def empty_map() -> LocalMap:
    """Return a map without points, the robot at its origin."""
    return LocalMap(
        np.empty((ROOM, 6)),
        np.empty(ROOM, np.int32),
        np.empty(ROOM, np.int32),
        np.full(SIDE * SIDE, -1, np.int32),
        np.zeros(2, np.int64),
        np.zeros(3),
        np.zeros(1),
    )


@kernel
def size(known: LocalMap) -> int:
    """Return the number of points."""
    return int(known.ring[1] - known.ring[0])


@kernel
def nearest(
    x: float,
    y: float,
    limit: float,
    hint: int,
    rows: Array,
    older: Links,
    cells: Links,
) -> int:
    """Return the row of the nearest point of a map within `limit` m, or -1.

    `hint` is the row of a point that is perhaps near, or -1: it spares looking farther than there.
    The map's arrays come one by one, because taking them out of a tuple costs as much as a look-up.
    """
    best, found = limit * limit, -1
    if hint >= 0:
        dx, dy = rows[hint, 0] - x, rows[hint, 1] - y
        if dx * dx + dy * dy < best:
            best, found = dx * dx + dy * dy, hint
    reach = math.sqrt(best)
    low, high = _cell(y - reach), _cell(y + reach)
    for i in range(_cell(x - reach), _cell(x + reach) + 1):
        for j in range(low, high + 1):
            row = cells[_place(i, j)]
            while row >= 0:
                dx, dy = rows[row, 0] - x, rows[row, 1] - y
                if dx * dx + dy * dy < best:
                    best, found = dx * dx + dy * dy, row
                row = older[row]
    return found


@kernel
def _cell(along: float) -> int:
    return math.floor(along * (1.0 / CELL))


@kernel
def _place(i: int, j: int) -> int:
    return (i & (SIDE - 1)) * SIDE + (j & (SIDE - 1))


@kernel
def add(known: LocalMap, points: Array, spacing: float, memory: float) -> None:
    """Enter the points that are new here, `Surfels.rows` of a sweep; forget those seen too long ago."""
    while size(known) and known.rows[known.ring[0] % ROOM, 5] <= known.way[0] - memory:
        _forget(known)
    rows, older, newer, cells, ring, pose, way = known
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for k in range(len(points)):
        x = pose[0] + c * points[k, 0] - s * points[k, 1]
        y = pose[1] + s * points[k, 0] + c * points[k, 1]
        if nearest(x, y, spacing, -1, rows, older, cells) >= 0:
            continue
        if ring[1] - ring[0] == ROOM:
            _forget(known)
        row, cell = ring[1] % ROOM, _place(_cell(x), _cell(y))
        rows[row, 0], rows[row, 1] = x, y
        rows[row, 2] = c * points[k, 2] - s * points[k, 3]
        rows[row, 3] = s * points[k, 2] + c * points[k, 3]
        rows[row, 4], rows[row, 5] = points[k, 4], way[0]
        newest = cells[cell]
        older[row], newer[row], cells[cell] = newest, -1, row
        if newest >= 0:
            newer[newest] = row
        ring[1] += 1


@kernel
def _forget(known: LocalMap) -> None:
    """Take the oldest point out, which is the last one of its cell's chain."""
    row = known.ring[0] % ROOM
    newer = known.newer[row]
    if newer >= 0:
        known.older[newer] = -1
    else:
        known.cells[_place(_cell(known.rows[row, 0]), _cell(known.rows[row, 1]))] = -1
    known.ring[0] += 1
