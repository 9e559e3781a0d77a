"""Surface maps in tiles, which several maps can share.

A tile is a `SurfaceMap` of a square of `TILE` m with a margin around it. Points in the margin are added,
too, so that the tile alone finds the nearest surfel of all points in its square. Tiles are copied on write:
maps that differ in a tile have one each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import (
    CELL,
    RADIUS,
    FitSums,
    SurfaceMap,
    add,
    clear,
    normal_equations,
)
from impslam.surfaces.zero_pages import zero_pages
from impslam.types import Array, Ints

CELLS = 80  # along a side of a tile's square
TILE = CELLS * CELL  # m: a room; few tiles are in view, and little is copied when maps diverge
MARGIN = 2 * RADIUS + 1
"""Cells: `add` takes points RADIUS + 1 from the edge, which matter up to RADIUS away."""
SURFELS = 2048  # of a tile: a quarter of its cells
_SIZE = CELLS + 2 * MARGIN


class Tiles(NamedTuple):
    """A pool of t tiles; see `SurfaceMap` for the fields."""

    cells: np.ndarray[tuple[int, ...], np.dtype[np.int32]]
    surfels: Array
    size: Ints
    corner: Array


def empty_tiles(count: int) -> Tiles:
    """Return a pool of empty tiles; memory is only used once they are written."""
    return Tiles(
        zero_pages((count, _SIZE, _SIZE), np.int32),
        zero_pages((count, SURFELS, 8), np.float64),
        np.zeros(count, np.int64),
        np.zeros((count, 2)),
    )


@kernel
def tile(pool: Tiles, k: int) -> SurfaceMap:
    """Return a tile as a map that shares its memory."""
    return SurfaceMap(pool.cells[k], pool.surfels[k], pool.size[k : k + 1], pool.corner[k])


@kernel
def begin(pool: Tiles, k: int, column: int, row: int) -> None:
    """Clear a tile, and move it to a column and row of tiles."""
    corner = np.empty(2)
    corner[0], corner[1] = column * TILE - MARGIN * CELL, row * TILE - MARGIN * CELL
    clear(tile(pool, k), corner)


@kernel
def copy(source: Tiles, k: int, pool: Tiles, target: int) -> None:
    """Copy tile k of `source` to tile `target` of `pool`, which may be the same."""
    pool.cells[target] = source.cells[k]
    pool.surfels[target, : source.size[k]] = source.surfels[k, : source.size[k]]
    pool.size[target] = source.size[k]
    pool.corner[target] = source.corner[k]


@kernel
def touched_tiles(features: Features, pose: Array) -> Ints:
    """Return the columns and rows (n, 2) of the tiles touched by features of a scan at a pose (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    out, count, radius = np.empty((len(features) * 4, 2), np.int64), 0, RADIUS * CELL
    for i in range(len(features)):
        x = pose[0] + c * features[i, 0] - s * features[i, 1]
        y = pose[1] + s * features[i, 0] + c * features[i, 1]
        for column in range(math.floor((x - radius) / TILE), math.floor((x + radius) / TILE) + 1):
            for row in range(math.floor((y - radius) / TILE), math.floor((y + radius) / TILE) + 1):
                listed = False
                for k in range(count - 1, -1, -1):  # neighbouring beams end in one tile
                    if out[k, 0] == column and out[k, 1] == row:
                        listed = True
                        break
                if not listed:
                    out[count, 0], out[count, 1] = column, row
                    count += 1
    return out[:count].copy()


@kernel
def add_to_tiles(
    pool: Tiles, tiles: Ints, features: Features, pose: Array, max_points: float
) -> None:
    """Add the features of a scan at a pose (3,) to tiles (n,); see `surface_map.add`."""
    for k in tiles:
        add(tile(pool, k), features, pose, max_points)


class Sorted(NamedTuple):
    """Features grouped by tile: those in `tiles[k]` of (n,) are rows `starts[k]` to `starts[k + 1]`."""

    features: Features
    tiles: Ints
    starts: Ints


@kernel
def sort(table: Ints, origin: Ints, features: Features, pose: Array) -> Sorted:
    """Return the features of a scan near a pose (3,) that fall into existing tiles.

    `table` (rows, columns) holds the tiles of a map, -1 for none, from column and row `origin` (2,) on.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    tiles = np.full(len(features), -1)
    for i in range(len(features)):
        x = pose[0] + c * features[i, 0] - s * features[i, 1]
        y = pose[1] + s * features[i, 0] + c * features[i, 1]
        column, row = math.floor(x / TILE) - origin[0], math.floor(y / TILE) - origin[1]
        if 0 <= row < table.shape[0] and 0 <= column < table.shape[1]:
            tiles[i] = table[row, column]
    out, used = np.empty_like(features), np.empty(len(features), np.int64)
    starts, n, count = np.zeros(len(features) + 1, np.int64), 0, 0
    for i in range(len(features)):
        if tiles[i] < 0:
            continue
        used[n], k = tiles[i], tiles[i]
        for j in range(i, len(features)):
            if tiles[j] == k:
                out[count] = features[j]
                count += 1
                tiles[j] = -1
        n += 1
        starts[n] = count
    return Sorted(out[:count], used[:n], starts[: n + 1])


@kernel
def evidence(pool: Tiles, seen: Sorted, pose: Array, scale: float, out: FitSums) -> None:
    """Fill `out` with the evidence of sorted features for a pose (3,); see `normal_equations`."""
    part = FitSums(np.empty((3, 3)), np.empty(3), np.empty(4))
    out.H[:], out.g[:], out.sums[:] = 0.0, 0.0, 0.0
    for k in range(len(seen.tiles)):
        features = seen.features[seen.starts[k] : seen.starts[k + 1]]
        normal_equations(tile(pool, seen.tiles[k]), features, pose, scale, 1, part)
        out.H[:] += part.H
        out.g[:] += part.g
        out.sums[:] += part.sums
