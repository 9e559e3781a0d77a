"""Search of the whole map for the places at which points fit best, in order of their scores.

As in `correlative`, the maximum likelihood in a block of cells bounds the scores of all poses in it. The
bounds of all coarse blocks at all headings are computed at once (see `coarse_sums`). Blocks are then in one
queue, and the most promising one is opened next (best-first branch and bound, Land & Doig 1960), so places
are found in the order of their scores. The queue has a bucket for each score: the bound of a block never
exceeds that of its parent, so the greatest bucket only decreases.

Places are local maxima: poses within `SEPARATION` and `HEADING_SEPARATION` of a better one are the same
place. Coarse blocks use few points, whose mean represents all; their bounds are therefore only estimates.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel
from impslam.recognition.bucket_queue import BucketQueue, empty_queue, pop, push
from impslam.recognition.coarse_sums import BLOCK, LEVEL, REACH, Sums, coarse_sums, runs_of
from impslam.recognition.correlative import spread_order
from impslam.recognition.pyramid import CELL, FULL, Bytes, Ints32, direction_of
from impslam.recognition.search_map import CHANCE, SearchMap
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

HEADINGS = 160  # half a step moves a point 8 m away by 16 cm, which the Gaussian bridges
POINTS, COARSE_POINTS = 100, 40  # standard error of the mean likelihood at most 0.04 and 0.06
MIN_SCORE = 0.3  # reached anywhere by chance
MIN_SHARE = 0.75  # of the best score; worse places are not returned
MAX_PLACES = 60
SEPARATION, HEADING_SEPARATION = 0.5, 0.2  # m, rad
BUDGET, MIN_BUDGET, MAX_BUDGET = 4000, 400_000, 4_000_000
"""Maximum number of blocks per m^2 of the map that are opened, and its limits; 0.2 us each."""
_COLUMN, _ROW, _LEVEL = 20, 20, 4  # bits of a block's key


class Places(NamedTuple):
    """The result of a search.

    Attributes
    ----------
    poses : (k, 3) position of the lidar and heading of its frame, best first
    scores : (k,) mean likelihood
    complete : whether the search ended within its budget
    """

    poses: Array
    scores: Array
    complete: bool


class _Task(NamedTuple):
    """State of a search: grids, rotated points (direction, column, row), and number of blocks."""

    levels: Bytes
    allowed: Bytes
    rotated: Ints32  # (HEADINGS, n, 3)
    evaluated: Ints  # (1,) number of blocks


def search_everywhere(
    search_map: SearchMap, points: Features, allowed: Bytes | None = None
) -> Places:
    """Return the places at which features (n, 5) seen by a lidar at (0, 0) fit best.

    Those farther than `REACH` are left out. `allowed` restricts the position of the lidar; see
    `SearchMap.allowed`.
    """
    ordered = _selected(points)
    count = len(ordered)
    if count == 0:
        return Places(np.empty((0, 3)), np.empty(0), complete=False)
    found = np.zeros((MAX_PLACES, 4), np.int64)
    allowed = search_map.allowed if allowed is None else allowed
    budget = int(np.clip(BUDGET * search_map.area, MIN_BUDGET, MAX_BUDGET))
    grids = search_map.likelihood, search_map.coarse, allowed
    number, complete = _search(grids, ordered, budget, found)
    found = found[:number]
    poses = np.empty((number, 3))
    poses[:, :2] = search_map.corner + (found[:, 1:3] + 0.5) * CELL
    poses[:, 2] = wrap(found[:, 0].astype(np.float64) * (2.0 * math.pi / HEADINGS))
    return Places(poses, found[:, 3] / (FULL * count), bool(complete))


def _selected(points: Features) -> Array:
    """Return the points to search with, in an order whose every prefix is spread evenly.

    Points on surfaces are preferred, because few walls have their direction; all are used if they are few.
    """
    points = points[np.hypot(points[:, 0], points[:, 1]) < REACH]
    surfaces = points[points[:, 4] > 0.0]
    some = surfaces if len(surfaces) >= COARSE_POINTS else points
    count = min(POINTS, len(some))
    even = some[np.arange(count) * len(some) // max(count, 1)].astype(np.float64)
    return np.ascontiguousarray(even[spread_order(count)])


@kernel
def _search(
    grids: tuple[Bytes, Bytes, Bytes], points: Array, budget: int, found: Ints
) -> tuple[int, bool]:
    """Fill `found` (m, 4) with heading, column, row and sum of the places; return their number."""
    levels, coarse, allowed = grids
    task = _Task(levels, allowed, _rotated(points), np.zeros(1, np.int64))
    full = FULL * len(points)
    runs = runs_of(allowed[LEVEL])
    some = np.ascontiguousarray(task.rotated[:, :COARSE_POINTS])
    sums = coarse_sums(coarse, allowed[LEVEL], runs, some)
    least = max(int(MIN_SCORE * full), int(MIN_SHARE * _reached(task, sums, runs)))
    queue = _queue(sums, runs, len(points) / some.shape[1], (least, full, budget))
    number = 0
    while number < len(found):
        bound, key = pop(queue)
        if bound <= least:
            return number, True
        column, row = key & ((1 << _COLUMN) - 1), (key >> _COLUMN) & ((1 << _ROW) - 1)
        level = (key >> (_COLUMN + _ROW)) & ((1 << _LEVEL) - 1)
        heading = key >> (_COLUMN + _ROW + _LEVEL)
        if _is_found(found[:number], heading, column, row, 1 << level):
            continue
        if level == 0:
            found[number, 0], found[number, 1], found[number, 2] = heading, column, row
            found[number, 3] = bound
            number += 1
            least = max(least, int(MIN_SHARE * found[0, 3]))
            continue
        if task.evaluated[0] > budget - 4:
            return number, False
        for quarter in range(4):
            block = _quarter(heading, level, column, row, quarter)
            total = min(_sum(task, block, least), bound)
            if total > least:
                push(queue, total, _key(block))
    return number, True


@kernel
def _reached(task: _Task, sums: Sums, runs: Ints) -> int:
    """Return the greatest sum of a place in the best block of each heading: the best sum is no less."""
    reached = 0
    for heading in range(len(sums) if len(runs) else 0):
        at = np.argmax(sums[heading])
        i = np.searchsorted(runs[:, 3], at, side="right") - 1
        block = heading, LEVEL, (runs[i, 1] + at - runs[i, 3]) * BLOCK, runs[i, 0]
        total = 0
        while block[1] > 0:
            parent, total = block, -1
            for quarter in range(4):
                child = _quarter(*parent, quarter)
                fit = _sum(task, child, 0)
                if fit > total:
                    block, total = child, fit
        reached = max(reached, total)
    return reached


@kernel
def _queue(sums: Sums, runs: Ints, scale: float, limits: tuple[int, int, int]) -> BucketQueue:
    """Return a queue of the coarse blocks.

    Parameters
    ----------
    scale : number of all points for each one in a sum
    limits : the bound that a block in the queue exceeds, the highest bound, and the number of other blocks
        for which the queue has space
    """
    least, highest, space = limits
    count = 0
    for heading in range(len(sums)):
        for total in sums[heading]:
            count += int(total * scale) > least
    queue = empty_queue(highest, count + space)
    for heading in range(len(sums)):
        for row, first, count, before in runs:
            for k in range(count):
                bound = int(sums[heading, before + k] * scale)
                if bound > least:
                    push(queue, bound, _key((heading, LEVEL, (first + k) * BLOCK, row)))
    return queue


@kernel
def _quarter(
    heading: int, level: int, column: int, row: int, quarter: int
) -> tuple[int, int, int, int]:
    """Return a quarter of a block."""
    half = 1 << (level - 1)
    return heading, level - 1, column + (quarter & 1) * half, row + (quarter >> 1) * half


@kernel
def _key(block: tuple[int, int, int, int]) -> int:
    """Return a block (heading, level, column, row) as one number."""
    heading, level, column, row = block
    return ((heading << _LEVEL | level) << _ROW | row) << _COLUMN | column


@kernel
def _sum(task: _Task, block: tuple[int, int, int, int], least: int) -> int:
    """Return the sum of the points' likelihoods for the lidar in a block; 0 if at most `least`."""
    heading, level, first_column, first_row = block
    _, height, width = task.allowed.shape
    if (
        first_row >= height
        or first_column >= width
        or not task.allowed[level, first_row, first_column]
    ):
        return 0
    task.evaluated[0] += 1
    points, grid = task.rotated[heading], task.levels[level]
    total, outside = 0, int(FULL * CHANCE)
    for i in range(len(points)):
        column, row = points[i, 1] + first_column, points[i, 2] + first_row
        if 0 <= column < width and 0 <= row < height:
            total += int(grid[points[i, 0], row, column])
        else:
            total += outside
        if i & 7 == 7 and total + FULL * (len(points) - 1 - i) <= least:
            return 0
    return total


@kernel
def _rotated(points: Array) -> Ints32:
    """Return direction, column and row (HEADINGS, n, 3) of points, relative to the lidar's cell."""
    out = np.empty((HEADINGS, len(points), 3), np.int32)
    for a in range(HEADINGS):
        angle = 2.0 * math.pi * a / HEADINGS
        c, s = math.cos(angle), math.sin(angle)
        for i in range(len(points)):
            x, y, nx, ny, weight = points[i]
            out[a, i, 0] = direction_of(c * nx - s * ny, s * nx + c * ny, weight)
            out[a, i, 1] = math.floor((c * x - s * y) / CELL + 0.5)
            out[a, i, 2] = math.floor((s * x + c * y) / CELL + 0.5)
    return out


@kernel
def _is_found(found: Ints, heading: int, column: int, row: int, block: int) -> bool:
    """Return whether a whole block belongs to a place that was found."""
    for k in range(len(found)):
        turn = abs(heading - found[k, 0])
        if min(turn, HEADINGS - turn) * (2.0 * math.pi / HEADINGS) > HEADING_SEPARATION:
            continue
        x = max(abs(column - found[k, 1]), abs(column + block - 1 - found[k, 1]))
        y = max(abs(row - found[k, 2]), abs(row + block - 1 - found[k, 2]))
        if (x * x + y * y) * CELL**2 < SEPARATION**2:
            return True
    return False
