"""What a map tells of each place: what is free and what is a wall, and how well a point fits there.

The occupancy grid of the map is kept in three forms. The likelihood grid, with its maxima over blocks, is
for the search of a pose (see `everywhere`); the distance to the nearest wall is for walking along beams
(see `beams`); the surfaces are for alignment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.map import Keyframes
from impslam.maps.grid import HIT, OccupancyGrid
from impslam.recognition.pyramid import BLUR, CELL, FULL, Bytes, Pyramid, pool
from impslam.recognition.submap import FARTHEST, View
from impslam.surfaces.surface_map import SurfaceMap, add, empty_surface_map
from impslam.types import Array, Mask

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

SIDE = 0.5 * CELL  # m, cells of the occupancy grid
LEVELS = 6  # of the pyramids: blocks of up to 3.2 m, the width of a room
UNKNOWN, FREE, OCCUPIED, SOLID = range(4)
SURE = 2.9 * HIT
"""Log-odds of a wall that nothing can be behind: three beams more have ended here than passed."""
CHANCE = 0.2
"""Likelihood of a point where nobody has looked: something to hit is there as often as within the
Gaussian around the walls of a room, which cover a fifth of it."""
LEAST = 0.02  # likelihood: less is none
CLEAR = 0.15  # m from a wall, at least, to the place of a lidar
FAR = 5.0  # m, the greatest distance that is told
VICINITY = 10.0  # m from a keyframe, at most: farther away a scan sees too little of what they saw
EDGE = 2  # cells that nobody has looked at, around a grid
MOST = 20.0  # points that a surfel averages over
SURFELS = 40  # for each m^2 of wall cells and their surroundings, at most


class Ground(NamedTuple):
    """What a map tells of each place.

    Attributes
    ----------
    state : (h, w) UNKNOWN, FREE, OCCUPIED or SOLID, in cells of `SIDE` m
    distance : (h, w) m from the cell to the nearest occupied one
    corner : (2,) m, the lower left corner of all grids
    likelihood : of a point in cells of `CELL` m
    room : (LEVELS, h / 2, w / 2) 1 where a lidar may stand anywhere in the block
    surfaces : that the map's scans saw
    """

    state: Bytes
    distance: Floats
    corner: Array
    likelihood: Pyramid
    room: Bytes
    surfaces: SurfaceMap

    @property
    def area(self) -> float:
        """m^2 where a lidar may stand."""
        return float(np.count_nonzero(self.room[0])) * CELL**2


def survey(keyframes: Keyframes, views: Sequence[View]) -> Ground:
    """Return what keyframes, and what each of them saw, tell of the places around them."""
    grid = OccupancyGrid(SIDE)
    _shortened(keyframes).draw(grid)
    logodds = np.pad(grid.logodds, [(EDGE, EDGE + n % 2) for n in grid.logodds.shape])
    corner = grid.origin - EDGE * SIDE
    occupied: Mask = np.greater(logodds, 0.0)
    state = np.where(logodds < 0.0, FREE, UNKNOWN).astype(np.uint8)
    state[occupied], state[logodds > SURE] = OCCUPIED, SOLID
    blocks = (state.shape[0] // 2, 2, state.shape[1] // 2, 2)
    free = (state == FREE).reshape(blocks).sum((1, 3)) > 2
    to_wall = _distance(np.logical_or.reduce(occupied.reshape(blocks), (1, 3)), CELL)
    close = _distance(_cells(keyframes.poses, corner, free.shape), CELL, VICINITY) < VICINITY
    room = _pyramid((free & close & (to_wall > CLEAR)).astype(np.uint8))
    return Ground(
        state,
        _distance(occupied, SIDE),
        corner,
        Pyramid(_pyramid(_likelihood(to_wall, free)), corner),
        room,
        _surfaces(keyframes.poses, views, corner, state.shape),
    )


def _shortened(keyframes: Keyframes) -> Keyframes:
    """Return keyframes without the points that are farther than `FARTHEST` from the lidar."""
    counts = np.diff(keyframes.starts)
    offsets = keyframes.points - np.repeat(keyframes.origins, counts, axis=0)
    close = np.hypot(offsets[:, 0], offsets[:, 1]) < FARTHEST
    starts = np.concatenate([[0], np.cumsum(close)])[keyframes.starts]
    return replace(keyframes, starts=starts, points=keyframes.points[close])


def _cells(poses: Array, corner: Array, shape: tuple[int, ...]) -> Mask:
    """Return a grid of a shape in cells of `CELL` m that marks where poses (k, 3) are."""
    marked = np.zeros(shape, np.bool_)
    columns, rows = np.floor((poses[:, :2] - corner) / CELL).astype(np.int64).T
    inside = (columns >= 0) & (columns < shape[1]) & (rows >= 0) & (rows < shape[0])
    marked[rows[inside], columns[inside]] = True
    return marked


def _likelihood(to_wall: Floats, free: Mask) -> Bytes:
    """Return the likelihood of a point by its distance from the next wall, 255 for 1."""
    likelihood = np.exp(-(to_wall**2) / (2.0 * BLUR**2))
    likelihood[likelihood < LEAST] = 0.0
    likelihood[~free] = np.maximum(likelihood[~free], CHANCE)
    cells: Bytes = (FULL * likelihood).astype(np.uint8)
    return cells


def _pyramid(ground: Bytes) -> Bytes:
    levels = np.empty((LEVELS, *ground.shape), np.uint8)
    levels[0] = ground
    pool(levels)
    return levels


def _distance(occupied: Mask, cell: float, most: float = FAR) -> Floats:
    """Return the distances from each cell to the nearest occupied one, at most so many m."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  slow to import

    if not occupied.any():
        return np.full(occupied.shape, most, np.float32)
    apart: Floats = np.minimum(distance_transform_edt(~occupied) * cell, most).astype(np.float32)
    return apart


def _surfaces(
    poses: Array, views: Sequence[View], corner: Array, shape: tuple[int, ...]
) -> SurfaceMap:
    """Return the surfaces that views at poses (k, 3) saw, on a grid of a shape in cells of `SIDE`."""
    count = sum(len(view.features) for view in views)
    known = empty_surface_map(shape[1] * SIDE, shape[0] * SIDE, max(count, 1))
    known.corner[:] = corner
    for view, pose in zip(views, poses, strict=True):
        add(known, view.features, np.ascontiguousarray(pose), MOST)
    return known._replace(surfels=known.surfels[: max(1, math.ceil(known.size[0]))].copy())
