"""A map prepared for relocalisation: its occupancy grid in the forms that search and scoring need.

The likelihood grid, with its maxima over blocks, is for the search of a pose (see `global_search`); the
distance to the nearest wall is for ray casting (see `beams`); the surfaces are for alignment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.geometry.se2 import transform
from impslam.map import Keyframes
from impslam.maps.distances import distances
from impslam.maps.grid import BALANCED, OccupancyGrid
from impslam.recognition.coarse_sums import BLOCK, LEVEL, lines
from impslam.recognition.free_ranges import MAX_RANGE
from impslam.recognition.pyramid import (
    CELL,
    DIRECTIONS,
    FULL,
    SECTOR,
    Bytes,
    draw,
    pool,
)
from impslam.recognition.submap import View
from impslam.surfaces.surface_map import MAX_POINTS, SurfaceMap, add, empty_surface_map
from impslam.types import Array, Mask

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

SIDE = 0.5 * CELL  # m, cells of the occupancy grid
LEVELS = LEVEL + 1  # of the pyramids
UNKNOWN, FREE, OCCUPIED, SOLID = range(4)
SOLID_LOG_ODDS = 2.9 * BALANCED.hit
"""Log-odds of a wall that no beam passes: three more beams have ended here than passed."""
CHANCE = 0.1
"""Likelihood of a point in unknown space: an object is as likely there as within the Gaussian around the
walls of a room, which covers a tenth of it."""
MIN_FACING = math.cos(0.5 * SECTOR + math.radians(20.0))
"""Cosine: normals of a scan and of the map may differ by 20 degrees and still have the same direction."""
OTHER_DIRECTION = 0.6
"""Likelihood of a point on a surface of another direction. At true poses in recorded buildings, 1 to 6 % of
the points are on such: clutter seen from its other side. In a room known from its door, half are."""
MAX_WALL_DISTANCE = 0.1  # m from a surface to a wall of the occupancy grid: up to two cells
CLEARANCE = 0.15  # m, minimum distance of a lidar from a wall
MAX_DISTANCE = 5.0  # m, at which distances are clipped
KEYFRAME_RADIUS = 10.0
"""m, maximum distance from a keyframe: farther away, views overlap too little."""
FREE_GAP = 1.1 * CELL
"""m from free space to cells between beams that are a degree apart, up to 10 m away."""
DRIVEN_RADIUS = 1.5
"""m around a keyframe where the lidar may be in unknown space: one that looks ahead does not see the floor
beside and behind it. In a hospital, mapped by such a lidar, a sixth of such places is unknown."""
MARGIN = 2 * BLOCK
"""Unknown cells around a grid: a block that begins outside is then in unknown space as a whole."""


class SearchMap(NamedTuple):
    """The grids and surfaces of a map.

    Attributes
    ----------
    state : (h, w) UNKNOWN, FREE, OCCUPIED or SOLID, in cells of `SIDE` m
    distance : (h, w) m from the cell to the nearest occupied one
    corner : (2,) m, the lower left corner of all grids
    likelihood : (LEVEL, DIRECTIONS + 1, h / 2, w / 2) maximum likelihood of a point in blocks of 2^level
        cells of `CELL` m, 255 for 1: of one with a normal around k `SECTOR`, and, last, of one without
    coarse : the next level; see `lines`
    allowed : (LEVELS, h / 2, w / 2) 1 if the lidar may be anywhere in the block
    surfaces : from the scans of the map
    """

    state: Bytes
    distance: Floats
    corner: Array
    likelihood: Bytes
    coarse: Bytes
    allowed: Bytes
    surfaces: SurfaceMap

    @property
    def area(self) -> float:
        """m^2 of possible lidar positions."""
        return float(np.count_nonzero(self.allowed[0])) * CELL**2


def make_search_map(keyframes: Keyframes, views: Sequence[View]) -> SearchMap:
    """Return the grids and surfaces of the placed keyframes, given their views."""
    placed = np.flatnonzero(keyframes.placed)
    poses, views = keyframes.poses[placed], [views[k] for k in placed.tolist()]
    grid = OccupancyGrid(SIDE, BALANCED)
    _without_far_points(keyframes).draw(grid)
    logodds = np.pad(grid.logodds, [(MARGIN, MARGIN + n % 2) for n in grid.logodds.shape])
    corner = grid.origin - MARGIN * SIDE
    occupied: Mask = np.greater(logodds, 0.0)
    state = np.where(logodds < 0.0, FREE, UNKNOWN).astype(np.uint8)
    state[occupied], state[logodds > SOLID_LOG_ODDS] = OCCUPIED, SOLID
    blocks = (state.shape[0] // 2, 2, state.shape[1] // 2, 2)
    free = (state == FREE).reshape(blocks).sum((1, 3)) > 2
    distance = _distance(occupied, SIDE)
    to_wall = distance[::2, ::2]
    surfaces = _surfaces(poses, views, corner, state.shape)
    to_keyframe = _distance(_cells(poses, corner, free.shape), CELL, KEYFRAME_RADIUS)
    near_free = _distance(free, CELL) < FREE_GAP
    inside = (near_free & (to_keyframe < KEYFRAME_RADIUS)) | (to_keyframe < DRIVEN_RADIUS)
    allowed = _pyramid((inside & (to_wall > CLEARANCE)).astype(np.uint8))
    likelihood, coarse = _pooled(_likelihood(poses, views, corner, distance, free))
    return SearchMap(state, distance, corner, likelihood, coarse, allowed, surfaces)


def _without_far_points(keyframes: Keyframes) -> Keyframes:
    """Return keyframes without the points that are farther than `MAX_RANGE` from the lidar."""
    counts = np.diff(keyframes.starts)
    offsets = keyframes.points - np.repeat(keyframes.origins, counts, axis=0)
    close = np.hypot(offsets[:, 0], offsets[:, 1]) < MAX_RANGE
    starts = np.concatenate([[0], np.cumsum(close)])[keyframes.starts]
    return replace(keyframes, starts=starts, points=keyframes.points[close])


def _cells(poses: Array, corner: Array, shape: tuple[int, ...]) -> Mask:
    """Return a mask of a shape, in cells of `CELL` m, of the cells of poses (k, 3)."""
    marked = np.zeros(shape, np.bool_)
    columns, rows = np.floor((poses[:, :2] - corner) / CELL).astype(np.int64).T
    inside = (columns >= 0) & (columns < shape[1]) & (rows >= 0) & (rows < shape[0])
    marked[rows[inside], columns[inside]] = True
    return marked


def _likelihood(
    poses: Array, views: Sequence[View], corner: Array, distance: Floats, free: Mask
) -> Bytes:
    """Return the likelihood of a point with a normal in each direction, and of one without a normal.

    Objects that are not in the occupancy grid, such as passers-by, are left out. Points without a normal,
    as on walls that few beams hit, count for every direction if there is no normal nearby.
    """
    points, facing = _points(poses, views)
    columns, rows = np.floor((points - corner) / SIDE).astype(np.int64).T
    inside = (columns >= 0) & (columns < distance.shape[1]) & (rows >= 0)
    inside &= rows < distance.shape[0]
    inside[inside] = distance[rows[inside], columns[inside]] < MAX_WALL_DISTANCE
    points, facing = np.ascontiguousarray(points[inside]), facing[inside]
    level = np.empty((DIRECTIONS + 1, *free.shape), np.uint8)
    level[:] = np.where(free, 0, np.uint8(FULL * CHANCE))
    for k in range(DIRECTIONS):
        draw(level[k], corner, points, np.cos(facing - k * SECTOR) > MIN_FACING)
    columns, rows = np.floor((points - corner) / CELL).astype(np.int64).T
    is_known = level[:DIRECTIONS, rows, columns].max(0) > FULL // 2
    for k in range(DIRECTIONS + 1):
        chosen = np.isnan(facing) & ~is_known | (k == DIRECTIONS)
        draw(level[k], corner, points, chosen)
    on_any = (OTHER_DIRECTION * level[DIRECTIONS]).astype(np.uint8)
    np.maximum(level[:DIRECTIONS], on_any, out=level[:DIRECTIONS])
    return level


def _pooled(likelihood: Bytes) -> tuple[Bytes, Bytes]:
    """Return the levels of the likelihood (k, h, w), without and as the last one; see `SearchMap`."""
    pyramids = [_pyramid(level) for level in likelihood]
    fine = np.stack([levels[:LEVEL] for levels in pyramids], axis=1)
    return fine, lines(np.stack([levels[LEVEL] for levels in pyramids]), int(FULL * CHANCE))


def _points(poses: Array, views: Sequence[View]) -> tuple[Array, Array]:
    """Return all features in map: points (n, 2) and directions of normals, rad, NaN without."""
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


def _pyramid(cells: Bytes) -> Bytes:
    levels = np.empty((LEVELS, *cells.shape), np.uint8)
    levels[0] = cells
    pool(levels)
    return levels


def _distance(marked: Mask, cell: float, limit: float = MAX_DISTANCE) -> Floats:
    """Return the distance from each cell to the nearest one in a mask, clipped at `limit`, m."""
    distance: Floats = np.minimum(distances(marked, cell), np.float32(limit))
    return distance


def _surfaces(
    poses: Array, views: Sequence[View], corner: Array, shape: tuple[int, ...]
) -> SurfaceMap:
    """Return the surfaces of views at poses (k, 3), on a grid of a shape in cells of `SIDE`."""
    count = sum(len(view.features) for view in views)
    known = empty_surface_map(shape[1] * SIDE, shape[0] * SIDE, max(count, 1))
    known.corner[:] = corner
    for view, pose in zip(views, poses, strict=True):
        add(known, view.features, np.ascontiguousarray(pose), MAX_POINTS)
    return known._replace(surfels=known.surfels[: known.size[0]].copy())
