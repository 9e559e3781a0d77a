"""Changes between two maps of a place: walls that are gone, and new ones.

A wall is gone if several later scans see through it. Places that were not seen later are not reported. New
walls are found in the same way, with the maps exchanged.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from impslam.building.free_space import profile, seen_through
from impslam.map import Map
from impslam.maps.grid import BALANCED, OccupancyGrid, PlacedScans
from impslam.types import Array, Ints, Mask

RESOLUTION = 0.05
"""m, side of the cells that are compared."""
CERTAIN = 2.5 * BALANCED.hit
"""Log-odds of a wall, and negated of free space: three more scans for it than against."""
POSSIBLE = 0.5 * BALANCED.hit
"""Minimum log-odds of a cell of the other map to be the wall: one more scan."""
MIN_SCANS = 3
"""Scans that see through a wall: fewer may be beams at an edge."""
TOLERANCE = 0.2
"""m: a wall has not moved if it is found again so close. Two good maps differ by a few centimetres, and
relevant changes are larger. A beam that ends so far behind a wall has passed through it."""
WIDTH = 0.1
"""m: all beams within this distance of a cell must pass through it."""
MAX_GAP = 0.15
"""m between cells of one piece."""
MIN_LENGTH = 0.15
"""m: smaller pieces are noise, or legs of chairs, which move often."""
NEIGHBOURS = 3
"""Cells on each side from which the direction of a wall is determined."""
MAX_ASPECT = 0.25
"""Standard deviation across a line over that along it; with more, the cells have no direction."""


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
    """Pieces of walls that are gone, and new ones, each sorted from longest to shortest."""

    gone: tuple[Change, ...]
    new: tuple[Change, ...]


def changes(before: Map, after: Map) -> Changes:
    """Return the changes from one map to another in the same frame."""
    grids = _drawn(before), _drawn(after)
    low = np.minimum(*(grid.corner for grid in grids))
    high = np.maximum(*(grid.corner + np.array(grid.logodds.shape[::-1]) for grid in grids))
    one, two = (_cropped(grid, low, high) for grid in grids)
    return Changes(_vanished(one, two, after, low), _vanished(two, one, before, low))


def _drawn(known: Map) -> OccupancyGrid:
    grid = OccupancyGrid(RESOLUTION, BALANCED)
    known.keyframes.draw(grid)
    return grid


def _cropped(grid: OccupancyGrid, low: Ints, high: Ints) -> Array:
    """Return the log-odds of the cells from low (column, row) up to high."""
    out = np.zeros((high - low)[::-1], np.float32)
    column, row = grid.corner - low
    rows, columns = grid.logodds.shape
    out[row : row + rows, column : column + columns] = grid.logodds
    return out


def _vanished(before: Array, after: Array, later: Map, low: Ints) -> tuple[Change, ...]:
    """Return the walls of one grid that the other one, and the scans of its map, contradict."""
    walls = before >= CERTAIN
    missing = walls & (after <= -CERTAIN) & ~_dilated(after > POSSIBLE, TOLERANCE)
    rows, columns = np.nonzero(missing)
    centres = np.asarray((np.column_stack([columns, rows]) + low + 0.5) * RESOLUTION, np.float64)
    through = _seen_through(centres, _normals(walls, rows, columns), later)
    missing[rows, columns] = through
    count, labels = cv2.connectedComponents(_dilated(missing, 0.5 * MAX_GAP).astype(np.uint8))
    piece, centres = labels[rows, columns][through], centres[through]
    found = (_change(centres[piece == k]) for k in range(1, count))
    return tuple(sorted((c for c in found if c.length >= MIN_LENGTH), key=lambda c: -c.length))


def _seen_through(points: Array, normals: Array, later: Map) -> Mask:
    """Return (p,) whether enough later scans see through each point."""
    if not len(points):
        return np.zeros(0, np.bool_)
    keyframes = later.keyframes.take(np.flatnonzero(later.keyframes.placed))
    scans = PlacedScans(keyframes.poses, keyframes.origins, keyframes.starts, keyframes.points)
    each = np.arange(len(points) + 1)
    counts = seen_through(profile(scans), points, normals, each, TOLERANCE, WIDTH)
    return np.asarray(counts >= MIN_SCANS)


def _normals(walls: Mask, rows: Ints, columns: Ints) -> Array:
    """Return the normals (p, 2) of walls at some of their cells; NaN without a direction."""
    out = np.full((len(rows), 2), np.nan)
    for k, (row, column) in enumerate(zip(rows, columns, strict=True)):
        near = walls[max(row - NEIGHBOURS, 0) : row + NEIGHBOURS + 1]
        cells = np.argwhere(near[:, max(column - NEIGHBOURS, 0) : column + NEIGHBOURS + 1])[:, ::-1]
        spread, axes = np.linalg.eigh(np.cov(cells.T)) if len(cells) > 2 else (np.ones(2), None)
        if axes is not None and spread[0] < MAX_ASPECT**2 * spread[1]:
            out[k] = axes[:, 0]
    return out


def _dilated(mask: Mask, radius: float) -> Mask:
    """Return the cells within `radius` m of a set one."""
    cells = math.ceil(radius / RESOLUTION)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)


def _change(cells: Array) -> Change:
    """Return the change of a piece with these cells (n, 2) m."""
    middle = cells.mean(axis=0)
    _, axes = np.linalg.eigh((cells - middle).T @ (cells - middle))
    along = (cells - middle) @ axes[:, 1]
    return Change(middle, float(np.ptp(along)) + RESOLUTION, cells)
