"""A likelihood grid, and its maxima over blocks of cells.

A cell holds the likelihood of a point there: a Gaussian around the points of a reference. Level l of the
pyramid holds the maximum likelihood of 2^l x 2^l cells, so that one sum bounds the scores of as many poses
(Hess et al. 2016, Alg. 3). The likelihood of a point with a normal takes the side of the surface into
account: the back of a shelf is not its front.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.types import Array, Mask

Bytes: TypeAlias = np.ndarray[Any, np.dtype[np.uint8]]
Ints32: TypeAlias = np.ndarray[Any, np.dtype[np.int32]]

CELL = 0.1  # m
BLUR = 0.12  # m, of the Gaussian: range noise, and rounding of poses by half a cell
FULL = 255  # likelihood 1
DIRECTIONS, SECTOR = 4, math.pi / 2.0  # rad: normals are classified by the four sides of a room


class Pyramid(NamedTuple):
    """A likelihood grid and its maxima over blocks.

    Attributes
    ----------
    levels : (l + 1, h, w) uint8, of a point on any surface; cell [k, row, column] is the maximum of the
        2^k x 2^k cells of level 0 from there upwards and to the right
    facing : (DIRECTIONS, h, w) uint8, of a point with a normal around k `SECTOR`: of the surfaces that face
        less than 90 degrees away from it; at most that of level 0
    corner : (2,) m, the lower left corner
    """

    levels: Bytes
    facing: Bytes
    corner: Array


class GridMemory:
    """Memory that is reused for each grid: a grid is valid until the next one is made."""

    def __init__(self) -> None:
        self._bytes = np.empty(0, np.uint8)

    def take(self, *shape: int) -> Bytes:
        """Return an uninitialised array of a shape."""
        size = math.prod(shape)
        if size > len(self._bytes):
            self._bytes = np.empty(size, np.uint8)
        return self._bytes[:size].reshape(shape)


def build(points: Features, level: int, memory: GridMemory | None = None) -> Pyramid:
    """Return the pyramid of features (n, 5), n >= 1, up to a level."""
    low, high = points[:, :2].min(0).astype(float), points[:, :2].max(0).astype(float)
    below = 2 + (1 << level)  # cells: radius of the Gaussian, and blocks that begin outside
    corner = (np.floor(low / CELL) - below) * CELL
    width, height = (np.floor((high - corner) / CELL) + 4).astype(int)
    grids = (memory or GridMemory()).take(level + 1 + DIRECTIONS, height, width)
    _fill(grids[: level + 1], grids[level + 1 :], corner, points)
    return Pyramid(grids[: level + 1], grids[level + 1 :], corner)


@kernel
def _fill(levels: Bytes, facing: Bytes, corner: Array, points: Features) -> None:
    """Draw the points' Gaussians into level 0 and `facing`, and fill the levels above.

    Points without a normal may be on a surface of any direction.
    """
    levels[0], facing[:] = 0, 0
    draw(levels[0], corner, points[:, :2], np.ones(len(points), np.bool_))
    pool(levels)
    chosen = np.empty(len(points), np.bool_)
    for k in range(DIRECTIONS):
        c, s = math.cos(k * SECTOR), math.sin(k * SECTOR)
        for i in range(len(points)):
            towards = c * points[i, 2] + s * points[i, 3]
            chosen[i] = points[i, 4] == 0.0 or towards > 0.0
        draw(facing[k], corner, points[:, :2], chosen)


@kernel
def direction_of(nx: float, ny: float, weight: float) -> int:
    """Return which of the `DIRECTIONS` a normal has; `DIRECTIONS` of one without weight: unknown."""
    if weight == 0.0:
        return DIRECTIONS
    if abs(nx) >= abs(ny):
        return 0 if nx > 0.0 else 2
    return 1 if ny > 0.0 else 3


@kernel
def draw(cells: Bytes, corner: Array, points: Array | Features, chosen: Mask) -> None:
    """Draw the Gaussians of the `chosen` (n,) points (n, 2) into a grid; ignore points outside."""
    stamp = np.empty((5, 5), np.uint8)
    for r in range(5):
        for c in range(5):
            distance2 = ((r - 2) ** 2 + (c - 2) ** 2) * CELL**2
            stamp[r, c] = int(FULL * math.exp(-distance2 / (2.0 * BLUR**2)) + 0.5)
    height, width = cells.shape
    for i in range(len(points)):
        column = math.floor((points[i, 0] - corner[0]) / CELL)
        row = math.floor((points[i, 1] - corner[1]) / CELL)
        inside = 2 <= column < width - 2 and 2 <= row < height - 2
        if not (chosen[i] and inside) or cells[row, column] == FULL:
            continue
        for r in range(5):
            for c in range(5):
                cell = cells[row + r - 2, column + c - 2]
                cells[row + r - 2, column + c - 2] = max(cell, stamp[r, c])


@kernel
def pool(levels: Bytes) -> None:
    """Fill the levels above the first one with the maxima over blocks."""
    for level in range(1, len(levels)):
        _pool(levels[level - 1], levels[level], 1 << (level - 1))


@kernel
def _pool(below: Bytes, above: Bytes, step: int) -> None:
    """Fill a level with the maxima of four blocks of the one below; cells outside are 0."""
    height, width = below.shape
    inner = max(width - step, 0)
    for row in range(height):
        low, high, out = below[row], below[min(row + step, height - 1)], above[row]
        for c in range(inner):
            out[c] = max(low[c], low[c + step], high[c], high[c + step])
        for c in range(inner, width):
            out[c] = max(low[c], high[c])
