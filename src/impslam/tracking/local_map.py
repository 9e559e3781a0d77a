"""The points seen on the last metres, with normals, in grid cells for fast look-up.

Points are kept in a ring buffer in the order of their arrival, so that the oldest are removed without a
search. Cells are square and repeat every `SIDE` cells: points that far apart share a cell, which costs
time but changes nothing, because distances are compared.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

Links: TypeAlias = npt.NDArray[np.int32]
CAPACITY = 1 << 15
"""Maximum number of points; beyond, the oldest are removed. At 5 cm they line 1.6 km of walls."""
CELL = 0.125
"""m, side of a cell: a few points, of which a surface has one every 5 cm."""
SIDE = 256
"""Cells along an axis until they repeat, a power of two: every 32 m."""


class LocalMap(NamedTuple):
    """Points around the robot, and its pose. Kernels change all of it in place.

    Attributes
    ----------
    rows : (CAPACITY, 6) x, y, the normal, 1 on a straight surface, and m travelled when it was added
    older, newer : (CAPACITY,) neighbours of a point in the linked list of its cell, -1 at the ends
    cells : (SIDE * SIDE,) newest point of each cell, -1 if empty
    ring : (2,) number of points removed, and of points added so far
    pose : (3,) of base_link
    travelled : (1,) m so far
    """

    rows: Array
    older: Links
    newer: Links
    cells: Links
    ring: Ints
    pose: Array
    travelled: Array


def empty_map() -> LocalMap:
    """Return a map without points, with the robot at its origin."""
    return LocalMap(
        np.empty((CAPACITY, 6)),
        np.empty(CAPACITY, np.int32),
        np.empty(CAPACITY, np.int32),
        np.full(SIDE * SIDE, -1, np.int32),
        np.zeros(2, np.int64),
        np.zeros(3),
        np.zeros(1),
    )


@kernel
def size(local_map: LocalMap) -> int:
    """Return the number of points."""
    return int(local_map.ring[1] - local_map.ring[0])


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

    `hint` is the row of a point that may be near, or -1: it bounds the search.
    The map's arrays are passed one by one, because unpacking a tuple costs as much as a look-up.
    """
    best, nearest_row = limit * limit, -1
    if hint >= 0:
        dx, dy = rows[hint, 0] - x, rows[hint, 1] - y
        if dx * dx + dy * dy < best:
            best, nearest_row = dx * dx + dy * dy, hint
    reach = math.sqrt(best)
    low, high = _cell(y - reach), _cell(y + reach)
    for i in range(_cell(x - reach), _cell(x + reach) + 1):
        for j in range(low, high + 1):
            row = cells[_slot(i, j)]
            while row >= 0:
                dx, dy = rows[row, 0] - x, rows[row, 1] - y
                if dx * dx + dy * dy < best:
                    best, nearest_row = dx * dx + dy * dy, row
                row = older[row]
    return nearest_row


@kernel
def _cell(coordinate: float) -> int:
    return math.floor(coordinate * (1.0 / CELL))


@kernel
def _slot(i: int, j: int) -> int:
    return (i & (SIDE - 1)) * SIDE + (j & (SIDE - 1))


@kernel
def add(local_map: LocalMap, points: Array, spacing: float, memory: float) -> None:
    """Add the points of a sweep (`Surfels.rows`) that are new; remove those older than `memory` m."""
    while (
        size(local_map)
        and local_map.rows[local_map.ring[0] % CAPACITY, 5] <= local_map.travelled[0] - memory
    ):
        _remove_oldest(local_map)
    rows, older, newer, cells, ring, pose, travelled = local_map
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for k in range(len(points)):
        x = pose[0] + c * points[k, 0] - s * points[k, 1]
        y = pose[1] + s * points[k, 0] + c * points[k, 1]
        if nearest(x, y, spacing, -1, rows, older, cells) >= 0:
            continue
        if ring[1] - ring[0] == CAPACITY:
            _remove_oldest(local_map)
        row, cell = ring[1] % CAPACITY, _slot(_cell(x), _cell(y))
        rows[row, 0], rows[row, 1] = x, y
        rows[row, 2] = c * points[k, 2] - s * points[k, 3]
        rows[row, 3] = s * points[k, 2] + c * points[k, 3]
        rows[row, 4], rows[row, 5] = points[k, 4], travelled[0]
        newest = cells[cell]
        older[row], newer[row], cells[cell] = newest, -1, row
        if newest >= 0:
            newer[newest] = row
        ring[1] += 1


@kernel
def _remove_oldest(local_map: LocalMap) -> None:
    """Remove the oldest point, which is the last one in the list of its cell."""
    row = local_map.ring[0] % CAPACITY
    newer = local_map.newer[row]
    if newer >= 0:
        local_map.older[newer] = -1
    else:
        local_map.cells[_slot(_cell(local_map.rows[row, 0]), _cell(local_map.rows[row, 1]))] = -1
    local_map.ring[0] += 1
