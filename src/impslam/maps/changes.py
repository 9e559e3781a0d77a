"""What has changed between two maps of a place: walls gone, and new ones.

A wall is gone where later scans looked through it, again and again. Where nobody looked later, nothing is
known, and nothing is told. The new ones are those that are gone the other way round.
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
SURE = 2.5 * BALANCED.hit
"""Log-odds of a wall, and of free space with the other sign: three more scans spoke for it than against."""
STANDING = 0.5 * BALANCED.hit
"""Log-odds from which a cell of the other map may be the wall: one scan more."""
SCANS = 3
"""That must have looked through a wall, or it may have been a beam's edge."""
TOLERANCE = 0.2
"""m: a wall that is found again so close has not moved. Two good maps differ by a few centimetres, and
what a robot needs to know of is wider. A beam that ends so far behind a wall has gone through it."""
WIDTH = 0.1
"""m: beams that pass a wall within this must all go through it."""
JOINED = 0.15
"""m: cells this close are one piece."""
SHORTEST = 0.15
"""m: smaller pieces are noise, or the legs of chairs, which move all day."""
AROUND = 3
"""Cells on either side that tell the direction of a wall."""
LINE = 0.25
"""Of the spread along a line, its spread across is less; else the cells are an object of no direction."""


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


def changes(before: Map, after: Map) -> Changes:
    """Return what has changed from one map to another of the same frame."""
    grids = _drawn(before), _drawn(after)
    low = np.minimum(*(grid.corner for grid in grids))
    high = np.maximum(*(grid.corner + np.array(grid.logodds.shape[::-1]) for grid in grids))
    one, two = (_framed(grid, low, high) for grid in grids)
    return Changes(_vanished(one, two, after, low), _vanished(two, one, before, low))


def _drawn(known: Map) -> OccupancyGrid:
    grid = OccupancyGrid(RESOLUTION, BALANCED)
    known.keyframes.draw(grid)
    return grid


def _framed(grid: OccupancyGrid, low: Ints, high: Ints) -> Array:
    """Return the log-odds of the cells from low (column, row) up to high."""
    out = np.zeros((high - low)[::-1], np.float32)
    column, row = grid.corner - low
    rows, columns = grid.logodds.shape
    out[row : row + rows, column : column + columns] = grid.logodds
    return out


def _vanished(before: Array, after: Array, later: Map, low: Ints) -> tuple[Change, ...]:
    """Return the walls of one grid that the other one, and the scans of its map, contradict."""
    walls = before >= SURE
    missing = walls & (after <= -SURE) & ~_widened(after > STANDING, TOLERANCE)
    rows, columns = np.nonzero(missing)
    places = np.asarray((np.column_stack([columns, rows]) + low + 0.5) * RESOLUTION, np.float64)
    through = _seen_through(places, _normals(walls, rows, columns), later)
    missing[rows, columns] = through
    count, labels = cv2.connectedComponents(_widened(missing, 0.5 * JOINED).astype(np.uint8))
    piece, places = labels[rows, columns][through], places[through]
    found = (_change(places[piece == k]) for k in range(1, count))
    return tuple(sorted((c for c in found if c.length >= SHORTEST), key=lambda c: -c.length))


def _seen_through(places: Array, normals: Array, later: Map) -> Mask:
    """Return (p,) whether later scans saw through each place."""
    if not len(places):
        return np.zeros(0, np.bool_)
    keyframes = later.keyframes.take(np.flatnonzero(later.keyframes.placed))
    scans = PlacedScans(keyframes.poses, keyframes.origins, keyframes.starts, keyframes.points)
    each = np.arange(len(places) + 1)
    counts = seen_through(profile(scans), places, normals, each, TOLERANCE, WIDTH)
    return np.asarray(counts >= SCANS)


def _normals(walls: Mask, rows: Ints, columns: Ints) -> Array:
    """Return the normals (p, 2) of walls at some of their cells; NaN where they have no direction."""
    out = np.full((len(rows), 2), np.nan)
    for k, (row, column) in enumerate(zip(rows, columns, strict=True)):
        near = walls[max(row - AROUND, 0) : row + AROUND + 1]
        cells = np.argwhere(near[:, max(column - AROUND, 0) : column + AROUND + 1])[:, ::-1]
        spread, axes = np.linalg.eigh(np.cov(cells.T)) if len(cells) > 2 else (np.ones(2), None)
        if axes is not None and spread[0] < LINE**2 * spread[1]:
            out[k] = axes[:, 0]
    return out


def _widened(mask: Mask, reach: float) -> Mask:
    """Return the cells within `reach` m of one that is set."""
    cells = math.ceil(reach / RESOLUTION)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)


def _change(cells: Array) -> Change:
    """Return the piece of some cells (n, 2) m."""
    middle = cells.mean(axis=0)
    _, axes = np.linalg.eigh((cells - middle).T @ (cells - middle))
    along = (cells - middle) @ axes[:, 1]
    return Change(middle, float(np.ptp(along)) + RESOLUTION, cells)
