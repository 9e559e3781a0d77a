"""Search of the whole map for the places at which points fit best, in order of their scores.

As in `correlative`, the maximum likelihood in a block of cells bounds the scores of all poses in it. Here
blocks of all headings are in one queue, and the most promising one is opened next (best-first branch and
bound, Land & Doig 1960), so places are found in the order of their scores. The queue has a bucket for each
score: the bound of a block never exceeds that of its parent, so the greatest bucket only decreases.

Places are local maxima: poses within `SEPARATION` and `HEADING_SEPARATION` of a better one are the same
place. Coarse levels use few points, whose mean represents all; their bounds are therefore only estimates.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel
from impslam.recognition.bucket_queue import BucketQueue, empty_queue, pop, push
from impslam.recognition.correlative import spread_order
from impslam.recognition.pyramid import CELL, FULL, Bytes, Ints32, direction_of
from impslam.recognition.search_map import CHANCE, SearchMap
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

HEADINGS = 160  # half a step moves a point 8 m away by 16 cm, which the Gaussian bridges
POINTS, COARSE_POINTS = 100, 40  # standard error of the mean likelihood at most 0.04 and 0.06
COARSE_LEVEL = 2  # first level with few points
MIN_SCORE = 0.3  # reached anywhere by chance
MIN_SHARE = 0.75  # of the best score; worse places are not returned
MAX_PLACES = 60
SEPARATION, HEADING_SEPARATION = 0.5, 0.2  # m, rad
BUDGET, MIN_BUDGET, MAX_BUDGET = 4000, 400_000, 4_000_000
"""Maximum number of blocks per m^2 of the map, and its limits; 0.2 us each."""
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
    """Return the places at which features (n, 5), n >= 1, seen by a lidar at (0, 0), fit best.

    `allowed` restricts the position of the lidar; see `SearchMap.allowed`.
    """
    ordered = _selected(points)
    count = len(ordered)
    found = np.zeros((MAX_PLACES, 4), np.int64)
    allowed = search_map.allowed if allowed is None else allowed
    budget = int(np.clip(BUDGET * search_map.area, MIN_BUDGET, MAX_BUDGET))
    number, complete = _search(search_map.likelihood, allowed, ordered, budget, found)
    found = found[:number]
    poses = np.empty((number, 3))
    poses[:, :2] = search_map.corner + (found[:, 1:3] + 0.5) * CELL
    poses[:, 2] = wrap(found[:, 0].astype(np.float64) * (2.0 * math.pi / HEADINGS))
    return Places(poses, found[:, 3] / (FULL * count), bool(complete))


def _selected(points: Features) -> Array:
    """Return the points to search with, in an order whose every prefix is spread evenly.

    Points on surfaces are preferred, because few walls have their direction; all are used if they are few.
    """
    surfaces = points[points[:, 4] > 0.0]
    some = surfaces if len(surfaces) >= COARSE_POINTS else points
    count = min(POINTS, len(some))
    even = some[np.arange(count) * len(some) // count].astype(np.float64)
    return np.ascontiguousarray(even[spread_order(count)])


@kernel
def _search(
    levels: Bytes, allowed: Bytes, points: Array, budget: int, found: Ints
) -> tuple[int, bool]:
    """Fill `found` (m, 4) with heading, column, row and sum of the places; return their number."""
    task = _Task(levels, allowed, _rotated(points), np.zeros(1, np.int64))
    full = FULL * len(points)
    queue = empty_queue(full, budget)
    min_sum, number = int(MIN_SCORE * full), 0
    _push_all(task, queue, min_sum)
    while number < len(found):
        bound, key = pop(queue)
        if bound <= min_sum:
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
            min_sum = max(min_sum, int(MIN_SHARE * found[0, 3]))
            continue
        if task.evaluated[0] > budget - 4:
            return number, False
        half = 1 << (level - 1)
        for quarter in range(4):
            x, y = column + (quarter & 1) * half, row + (quarter >> 1) * half
            _push(task, queue, (heading, level - 1, x, y), bound, min_sum)
    return number, True


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
def _push_all(task: _Task, queue: BucketQueue, min_sum: int) -> None:
    """Push the blocks of the highest level."""
    top, height, width = task.allowed.shape
    top -= 1
    for row in range(0, height, 1 << top):
        for column in range(0, width, 1 << top):
            for heading in range(HEADINGS if task.allowed[top, row, column] else 0):
                block = heading, top, column, row
                _push(task, queue, block, FULL * task.rotated.shape[1], min_sum)


@kernel
def _push(
    task: _Task, queue: BucketQueue, block: tuple[int, int, int, int], bound: int, min_sum: int
) -> None:
    """Push a block (heading, level, column, row) to the queue if its bound exceeds `min_sum`."""
    heading, level, column, row = block
    _, height, width = task.allowed.shape
    if row >= height or column >= width or not task.allowed[level, row, column]:
        return
    points = task.rotated[heading]
    n = len(points)
    used = n if level < COARSE_LEVEL else min(n, COARSE_POINTS)
    least = min_sum * used // n
    total = _sum(task.levels[level], points[:used], (column, row), 1 << level, least) * n // used
    total = min(total, bound)
    task.evaluated[0] += 1
    if total > min_sum:
        push(queue, total, ((heading << _LEVEL | level) << _ROW | row) << _COLUMN | column)


@kernel
def _sum(level: Bytes, points: Ints32, first: tuple[int, int], block: int, min_sum: int) -> int:
    """Return the sum of the points' likelihoods for the lidar in a block; 0 if at most `min_sum`."""
    _, height, width = level.shape
    total, outside = 0, int(FULL * CHANCE)
    for i in range(len(points)):
        column, row = points[i, 1] + first[0], points[i, 2] + first[1]
        if -block < column < 0:  # the block extends into the grid
            column = 0
        if -block < row < 0:
            row = 0
        if 0 <= column < width and 0 <= row < height:
            total += int(level[points[i, 0], row, column])
        else:
            total += outside
        if i & 7 == 7 and total + FULL * (len(points) - 1 - i) <= min_sum:
            return 0
    return total


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
