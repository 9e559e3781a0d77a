"""What has changed between two maps of a place: walls gone, and new ones.

A wall is gone where later scans saw free space in its place, again and again. Where nobody looked later,
nothing is known, and nothing is told. The new ones are those that are gone the other way round.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from impslam.errors import ConfigError
from impslam.maps.grid import HIT, OccupancyGrid
from impslam.types import Array, Ints, Mask

SURE = 2.5 * HIT
"""Log-odds of a wall, and of free space with the other sign: three more scans spoke for it than against."""
STILL = 0.5 * HIT
"""Log-odds from which a cell of the other map may be the wall: one scan more."""
TOLERANCE = 0.2
"""m: a wall that is found again so close has not moved. Two good maps differ by a few centimetres, and
what a robot needs to know of is wider."""
JOINED = 0.15
"""m: cells this close are one piece."""
SHORTEST = 0.15
"""m: smaller pieces are noise, or the legs of chairs, which move all day."""


class Change(NamedTuple):
    """A piece of wall that is gone or new.

    Attributes
    ----------
    position : (2,) m, its middle in map
    length : m, along its longer side
    cells : (n, 2) m, the middles of the grid's cells that it covers
    """

    position: Array
    length: float
    cells: Array


class Changes(NamedTuple):
    """Pieces of walls that are gone, and new ones, each from the longest to the shortest."""

    gone: tuple[Change, ...]
    new: tuple[Change, ...]


def changes(before: OccupancyGrid, after: OccupancyGrid) -> Changes:
    """Return what has changed from one grid to another of the same frame and the same cells.

    Raises
    ------
    ConfigError
        If their cells differ in size.
    """
    if before.resolution != after.resolution:
        raise ConfigError("grids of cells of two sizes cannot be compared; draw them alike")
    low = np.minimum(before.corner, after.corner)
    ends = [grid.corner + np.array(grid.logodds.shape[::-1]) for grid in (before, after)]
    high = np.maximum(*ends)
    one, two = (_framed(grid, low, high) for grid in (before, after))
    size = before.resolution
    return Changes(_vanished(one, two, low, size), _vanished(two, one, low, size))


def _framed(grid: OccupancyGrid, low: Ints, high: Ints) -> Array:
    """Return the log-odds of the cells from low (column, row) up to high."""
    out = np.zeros((high - low)[::-1], np.float32)
    column, row = grid.corner - low
    rows, columns = grid.logodds.shape
    out[row : row + rows, column : column + columns] = grid.logodds
    return out


def _vanished(before: Array, after: Array, low: Ints, size: float) -> tuple[Change, ...]:
    """Return the walls of one grid that the other one contradicts."""
    remains = _widened(after > STILL, TOLERANCE / size)
    mask = (before >= SURE) & (after <= -SURE) & ~remains
    pieces, labels = cv2.connectedComponents(_widened(mask, 0.5 * JOINED / size).astype(np.uint8))
    rows, columns = np.nonzero(mask)
    places = (np.column_stack([columns, rows]) + low + 0.5) * size
    piece = labels[rows, columns]
    found = (_change(places[piece == k], size) for k in range(1, pieces))
    return tuple(sorted((c for c in found if c.length >= SHORTEST), key=lambda c: -c.length))


def _widened(mask: Mask, cells: float) -> Mask:
    """Return the cells within so many of one that is set."""
    reach = int(np.ceil(cells))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)


def _change(cells: Array, size: float) -> Change:
    """Return the piece of some cells (n, 2) m."""
    middle = cells.mean(axis=0)
    _, axes = np.linalg.eigh((cells - middle).T @ (cells - middle))
    along = (cells - middle) @ axes[:, 1]
    return Change(middle, float(np.ptp(along)) + size, cells)
