"""Search of all of a map: the places where points fit best, best first.

As in `correlative`, the greatest likelihood in a block of cells bounds the scores of all poses in it. Here
blocks of all headings wait in one queue, and the most promising one is opened next (best-first branch and
bound, Land & Doig 1960), so that places come out in the order of their scores. The queue has a bucket for
each score: what is opened never promises more than its parent, so the greatest bucket only falls.

A place is a local best: what is as close to a better one as `APART` and `TURNED` is the same. Coarse levels
are judged by few points, whose mean stands for that of all; so their bounds are estimates, not exact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel
from impslam.recognition.correlative import spread
from impslam.recognition.ground import CHANCE, Ground
from impslam.recognition.pyramid import CELL, FULL, Bytes, Ints32
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

HEADINGS = (
    160  # half a step moves a point 8 m away by 16 cm, as far as the likelihood's Gaussian reaches
)
POINTS, COARSE_POINTS = 100, 40  # a mean likelihood to within 0.04 and 0.06, one sigma at most
COARSE = 2  # the first level that is judged by few points
LEAST = 0.3  # score: chance reaches it anywhere
SHARE = 0.75  # of the best score: places with less are not told
MOST = 30  # places
APART, TURNED = 0.5, 0.2  # m, rad
BUDGET = 400_000  # blocks judged
_COLUMN, _ROW, _LEVEL = 20, 20, 4  # bits of a block's key


class Places(NamedTuple):
    """What a search found.

    Attributes
    ----------
    poses : (k, 3) of the lidar's place and the heading of its frame, best first
    scores : (k,) mean likelihood
    complete : whether the search went through all that could be better
    """

    poses: Array
    scores: Array
    complete: bool


class _Task(NamedTuple):
    """Where is searched, and for what: columns and rows (HEADINGS, n) of the points, turned."""

    levels: Bytes
    room: Bytes
    columns: Ints32
    rows: Ints32


class _Queue(NamedTuple):
    """Blocks by their bound: a linked list for each; `first` (b,) and `after` (n,) are -1 at its end.

    `state` (3,) is the number of blocks that were entered, the greatest bound, and the blocks judged.
    """

    first: Ints32
    after: Ints32
    keys: Ints
    state: Ints


def search_everywhere(ground: Ground, points: Features, room: Bytes | None = None) -> Places:
    """Return the places where points (n, 2 or more columns; n >= 1) from a lidar at (0, 0) fit best.

    `room` narrows where the lidar may be; see `Ground.room`.
    """
    count = min(POINTS, len(points))
    even = points[np.arange(count) * len(points) // count, :2].astype(np.float64)
    ordered = np.ascontiguousarray(even[spread(count)])
    found = np.zeros((MOST, 4), np.int64)
    likelihood = ground.likelihood
    number, complete = _search(
        likelihood.levels, ground.room if room is None else room, ordered, found
    )
    found = found[:number]
    poses = np.empty((number, 3))
    poses[:, :2] = likelihood.corner + (found[:, 1:3] + 0.5) * CELL
    poses[:, 2] = wrap(found[:, 0].astype(np.float64) * (2.0 * math.pi / HEADINGS))
    return Places(poses, found[:, 3] / (FULL * count), bool(complete))


@kernel
def _search(levels: Bytes, room: Bytes, points: Array, found: Ints) -> tuple[int, bool]:
    """Fill `found` (m, 4) with heading, column, row and sum of the places; return how many there are."""
    task = _Task(levels, room, *_turned(points))
    full = FULL * len(points)
    queue = _Queue(
        np.full(full + 1, -1, np.int32),
        np.empty(BUDGET + 4, np.int32),
        np.empty(BUDGET + 4, np.int64),
        np.zeros(3, np.int64),
    )
    least, number = int(LEAST * full), 0
    _enter_all(task, queue, least)
    while number < len(found):
        bound, key = _pop(queue)
        if bound <= least:
            return number, True
        column, row = key & ((1 << _COLUMN) - 1), (key >> _COLUMN) & ((1 << _ROW) - 1)
        level = (key >> (_COLUMN + _ROW)) & ((1 << _LEVEL) - 1)
        heading = key >> (_COLUMN + _ROW + _LEVEL)
        if _known(found[:number], heading, column, row, 1 << level):
            continue
        if level == 0:
            found[number, 0], found[number, 1], found[number, 2] = heading, column, row
            found[number, 3] = bound
            number += 1
            least = max(least, int(SHARE * found[0, 3]))
            continue
        if queue.state[2] > BUDGET - 4:
            return number, False
        half = 1 << (level - 1)
        for quarter in range(4):
            x, y = column + (quarter & 1) * half, row + (quarter >> 1) * half
            _enter(task, queue, (heading, level - 1, x, y), bound, least)
    return number, True


@kernel
def _turned(points: Array) -> tuple[Ints32, Ints32]:
    """Return columns and rows (HEADINGS, n) of points, relative to the lidar's cell."""
    columns = np.empty((HEADINGS, len(points)), np.int32)
    rows = np.empty_like(columns)
    for a in range(HEADINGS):
        angle = 2.0 * math.pi * a / HEADINGS
        c, s = math.cos(angle) / CELL, math.sin(angle) / CELL
        for i in range(len(points)):
            columns[a, i] = math.floor(c * points[i, 0] - s * points[i, 1] + 0.5)
            rows[a, i] = math.floor(s * points[i, 0] + c * points[i, 1] + 0.5)
    return columns, rows


@kernel
def _enter_all(task: _Task, queue: _Queue, least: int) -> None:
    """Enter the blocks of the highest level."""
    top, height, width = task.levels.shape
    top -= 1
    for row in range(0, height, 1 << top):
        for column in range(0, width, 1 << top):
            for heading in range(HEADINGS if task.room[top, row, column] else 0):
                block = heading, top, column, row
                _enter(task, queue, block, FULL * task.columns.shape[1], least)


@kernel
def _enter(
    task: _Task, queue: _Queue, block: tuple[int, int, int, int], bound: int, least: int
) -> None:
    """Enter a block (heading, level, column, row) into the queue, if its bound exceeds `least`."""
    heading, level, column, row = block
    _, height, width = task.levels.shape
    if row >= height or column >= width or not task.room[level, row, column]:
        return
    columns, rows = task.columns[heading], task.rows[heading]
    n = len(columns)
    some = n if level < COARSE else min(n, COARSE_POINTS)
    total = _sum(task.levels[level], columns, rows, (column, row), some, 1 << level) * n // some
    total = min(total, bound)
    queue.state[2] += 1
    k = queue.state[0]
    if total <= least or k >= len(queue.keys):
        return
    key = ((heading << _LEVEL | level) << _ROW | row) << _COLUMN | column
    queue.keys[k], queue.after[k] = key, queue.first[total]
    queue.first[total] = k
    queue.state[0] += 1
    queue.state[1] = max(queue.state[1], total)


@kernel
def _sum(
    level: Bytes, columns: Ints32, rows: Ints32, first: tuple[int, int], count: int, block: int
) -> int:
    """Return the sum of the first `count` points' likelihoods for the lidar in a block."""
    height, width = level.shape
    total, outside = 0, int(FULL * CHANCE)
    for i in range(count):
        column, row = columns[i] + first[0], rows[i] + first[1]
        if -block < column < 0:  # the block reaches into the grid
            column = 0
        if -block < row < 0:
            row = 0
        if 0 <= column < width and 0 <= row < height:
            total += level[row, column]
        else:
            total += outside
    return total


@kernel
def _pop(queue: _Queue) -> tuple[int, int]:
    """Return the greatest bound and its block, and remove it; bound 0 if there is none."""
    best = queue.state[1]
    while best > 0 and queue.first[best] < 0:
        best -= 1
    queue.state[1] = best
    if best == 0:
        return 0, 0
    k = queue.first[best]
    queue.first[best] = queue.after[k]
    return best, queue.keys[k]


@kernel
def _known(found: Ints, heading: int, column: int, row: int, block: int) -> bool:
    """Tell whether all of a block belongs to a place that was found."""
    for k in range(len(found)):
        turn = abs(heading - found[k, 0])
        if min(turn, HEADINGS - turn) * (2.0 * math.pi / HEADINGS) > TURNED:
            continue
        x = max(abs(column - found[k, 1]), abs(column + block - 1 - found[k, 1]))
        y = max(abs(row - found[k, 2]), abs(row + block - 1 - found[k, 2]))
        if (x * x + y * y) * CELL**2 < APART**2:
            return True
    return False
