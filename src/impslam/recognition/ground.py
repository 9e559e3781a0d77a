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

from impslam.geometry.se2 import transform
from impslam.map import Keyframes
from impslam.maps.grid import BALANCED, OccupancyGrid
from impslam.recognition.pyramid import CELL, FULL, Bytes, draw, pool
from impslam.recognition.submap import FARTHEST, View
from impslam.surfaces.surface_map import SurfaceMap, add, empty_surface_map
from impslam.types import Array, Mask

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

SIDE = 0.5 * CELL  # m, cells of the occupancy grid
LEVELS = 5  # of the pyramids: blocks of up to 1.6 m, the width of a corridor
UNKNOWN, FREE, OCCUPIED, SOLID = range(4)
SURE = 2.9 * BALANCED.hit
"""Log-odds of a wall that nothing can be behind: three beams more have ended here than passed."""
CHANCE = 0.1
"""Likelihood of a point where nobody has looked: something to hit is there as often as within the
Gaussian around the walls of a room, which cover a tenth of it."""
DIRECTIONS, SECTOR = 4, math.pi / 2.0  # rad: normals are told apart by the four sides of a room
FACES = math.cos(0.5 * SECTOR + math.radians(20.0))
"""Cosine: normals of a scan and of the map may differ by 20 degrees, and have the same direction."""
KEPT = 0.1  # m: a surface is where the occupancy grid has a wall, or in the next cell but one
CLEAR = 0.15  # m from a wall, at least, to the place of a lidar
FAR = 5.0  # m, the greatest distance that is told
VICINITY = 10.0  # m from a keyframe, at most: farther away a scan sees too little of what they saw
EDGE = 2  # cells that nobody has looked at, around a grid
MOST = 20.0  # points that a surfel averages over


class Ground(NamedTuple):
    """What a map tells of each place.

    Attributes
    ----------
    state : (h, w) UNKNOWN, FREE, OCCUPIED or SOLID, in cells of `SIDE` m
    distance : (h, w) m from the cell to the nearest occupied one
    corner : (2,) m, the lower left corner of all grids
    likelihood : (LEVELS, DIRECTIONS + 1, h / 2, w / 2) of a point in blocks of 2^level cells of `CELL`
        m, 255 for 1: on a surface whose normal is within a sector of k `SECTOR`, and of any
    room : (LEVELS, h / 2, w / 2) 1 where a lidar may stand anywhere in the block
    surfaces : that the map's scans saw
    """

    state: Bytes
    distance: Floats
    corner: Array
    likelihood: Bytes
    room: Bytes
    surfaces: SurfaceMap

    @property
    def area(self) -> float:
        """m^2 where a lidar may stand."""
        return float(np.count_nonzero(self.room[0])) * CELL**2


def survey(keyframes: Keyframes, views: Sequence[View]) -> Ground:
    """Return what keyframes that are placed, and what each of them saw, tell of the places around."""
    placed = np.flatnonzero(keyframes.placed)
    poses, views = keyframes.poses[placed], [views[k] for k in placed.tolist()]
    grid = OccupancyGrid(SIDE, BALANCED)
    _shortened(keyframes).draw(grid)
    logodds = np.pad(grid.logodds, [(EDGE, EDGE + n % 2) for n in grid.logodds.shape])
    corner = grid.origin - EDGE * SIDE
    occupied: Mask = np.greater(logodds, 0.0)
    state = np.where(logodds < 0.0, FREE, UNKNOWN).astype(np.uint8)
    state[occupied], state[logodds > SURE] = OCCUPIED, SOLID
    blocks = (state.shape[0] // 2, 2, state.shape[1] // 2, 2)
    free = (state == FREE).reshape(blocks).sum((1, 3)) > 2
    distance = _distance(occupied, SIDE)
    to_wall = distance[::2, ::2]
    surfaces = _surfaces(poses, views, corner, state.shape)
    close = _distance(_cells(poses, corner, free.shape), CELL, VICINITY) < VICINITY
    room = _pyramid((free & close & (to_wall > CLEAR)).astype(np.uint8))
    likelihood = _likelihood(poses, views, corner, distance, free)
    return Ground(state, distance, corner, likelihood, room, surfaces)


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


def _likelihood(
    poses: Array, views: Sequence[View], corner: Array, distance: Floats, free: Mask
) -> Bytes:
    """Return the likelihood of a point on a surface that faces each of the directions, and any.

    What the occupancy grid has not kept, as somebody who walked by, is left out.
    """
    points, facing = _points(poses, views)
    columns, rows = np.floor((points - corner) / SIDE).astype(np.int64).T
    inside = (columns >= 0) & (columns < distance.shape[1]) & (rows >= 0)
    inside &= rows < distance.shape[0]
    inside[inside] = distance[rows[inside], columns[inside]] < KEPT
    points, facing = np.ascontiguousarray(points[inside]), facing[inside]
    levels = np.empty((LEVELS, DIRECTIONS + 1, *free.shape), np.uint8)
    levels[0] = np.where(free, 0, np.uint8(FULL * CHANCE))
    for k in range(DIRECTIONS + 1):
        chosen = np.cos(facing - k * SECTOR) > FACES  # not where the facing is NaN
        draw(levels[0, k], corner, points, chosen | (k == DIRECTIONS))
        pool(levels[:, k])
    return levels


def _points(poses: Array, views: Sequence[View]) -> tuple[Array, Array]:
    """Return all features in map: points (n, 2) and where they face, rad; NaN without a normal."""
    points = [
        transform(pose, v.features[:, :2].astype(np.float64))
        for pose, v in zip(poses, views, strict=True)
    ]
    facing = [
        np.where(v.features[:, 4] > 0.0, np.arctan2(v.features[:, 3], v.features[:, 2]), np.nan)
        + pose[2]
        for pose, v in zip(poses, views, strict=True)
    ]
    return np.concatenate([np.empty((0, 2)), *points]), np.concatenate([np.empty(0), *facing])


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
    return known._replace(surfels=known.surfels[: known.size[0]].copy())
