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
from impslam.recognition.bucket_queue import BucketQueue, empty_queue, pop, push
from impslam.recognition.correlative import spread
from impslam.recognition.ground import CHANCE, DIRECTIONS, SECTOR, Ground
from impslam.recognition.pyramid import CELL, FULL, Bytes, Ints32
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

HEADINGS = 160  # half a step moves a point 8 m away by 16 cm, which the Gaussian bridges
POINTS, COARSE_POINTS = 100, 40  # a mean likelihood to within 0.04 and 0.06, one sigma at most
COARSE = 2  # the first level that is judged by few points
LEAST = 0.3  # score: chance reaches it anywhere
SHARE = 0.8  # of the best score: places with less are not told
MOST = 30  # places
APART, TURNED = 0.5, 0.2  # m, rad
BUDGET, LEAST_BUDGET, MOST_BUDGET = 1000, 400_000, 4_000_000
"""Blocks judged at most, for each m^2 of the map, and in all; 0.2 us each."""
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
    """Where is searched, for what (directions, columns and rows of the points, turned), and how far."""

    levels: Bytes
    room: Bytes
    turned: Ints32  # (HEADINGS, n, 3)
    judged: Ints  # (1,) number of blocks


def search_everywhere(ground: Ground, points: Features, room: Bytes | None = None) -> Places:
    """Return the places where features (n, 5), n >= 1, seen by a lidar at (0, 0) fit best.

    `room` narrows where the lidar may be; see `Ground.room`.
    """
    ordered = _chosen(points)
    count = len(ordered)
    found = np.zeros((MOST, 4), np.int64)
    room = ground.room if room is None else room
    budget = int(np.clip(BUDGET * ground.area, LEAST_BUDGET, MOST_BUDGET))
    number, complete = _search(ground.likelihood, room, ordered, budget, found)
    found = found[:number]
    poses = np.empty((number, 3))
    poses[:, :2] = ground.corner + (found[:, 1:3] + 0.5) * CELL
    poses[:, 2] = wrap(found[:, 0].astype(np.float64) * (2.0 * math.pi / HEADINGS))
    return Places(poses, found[:, 3] / (FULL * count), bool(complete))


def _chosen(points: Features) -> Array:
    """Return the points to search with, in an order whose every beginning is spread over all.

    Those on surfaces tell more, for few walls face their way; others are used where these are few.
    """
    surfaces = points[points[:, 4] > 0.0]
    some = surfaces if len(surfaces) >= COARSE_POINTS else points
    count = min(POINTS, len(some))
    even = some[np.arange(count) * len(some) // count].astype(np.float64)
    return np.ascontiguousarray(even[spread(count)])


@kernel
def _search(
    levels: Bytes, room: Bytes, points: Array, budget: int, found: Ints
) -> tuple[int, bool]:
    """Fill `found` (m, 4) with heading, column, row and sum of the places; return how many there are."""
    task = _Task(levels, room, _turned(points), np.zeros(1, np.int64))
    full = FULL * len(points)
    queue = empty_queue(full, budget)
    least, number = int(LEAST * full), 0
    _enter_all(task, queue, least)
    while number < len(found):
        bound, key = pop(queue)
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
        if task.judged[0] > budget - 4:
            return number, False
        half = 1 << (level - 1)
        for quarter in range(4):
            x, y = column + (quarter & 1) * half, row + (quarter >> 1) * half
            _enter(task, queue, (heading, level - 1, x, y), bound, least)
    return number, True


@kernel
def _turned(points: Array) -> Ints32:
    """Return direction, column and row (HEADINGS, n, 3) of points, relative to the lidar's cell."""
    out = np.empty((HEADINGS, len(points), 3), np.int32)
    for a in range(HEADINGS):
        angle = 2.0 * math.pi * a / HEADINGS
        c, s = math.cos(angle), math.sin(angle)
        for i in range(len(points)):
            x, y, nx, ny, weight = points[i]
            facing = math.atan2(s * nx + c * ny, c * nx - s * ny)
            sector = math.floor(facing / SECTOR + 0.5) % DIRECTIONS
            out[a, i, 0] = sector if weight > 0.0 else DIRECTIONS
            out[a, i, 1] = math.floor((c * x - s * y) / CELL + 0.5)
            out[a, i, 2] = math.floor((s * x + c * y) / CELL + 0.5)
    return out


@kernel
def _enter_all(task: _Task, queue: BucketQueue, least: int) -> None:
    """Enter the blocks of the highest level."""
    top, height, width = task.room.shape
    top -= 1
    for row in range(0, height, 1 << top):
        for column in range(0, width, 1 << top):
            for heading in range(HEADINGS if task.room[top, row, column] else 0):
                block = heading, top, column, row
                _enter(task, queue, block, FULL * task.turned.shape[1], least)


@kernel
def _enter(
    task: _Task, queue: BucketQueue, block: tuple[int, int, int, int], bound: int, least: int
) -> None:
    """Enter a block (heading, level, column, row) into the queue, if its bound exceeds `least`."""
    heading, level, column, row = block
    _, height, width = task.room.shape
    if row >= height or column >= width or not task.room[level, row, column]:
        return
    points = task.turned[heading]
    n = len(points)
    some = n if level < COARSE else min(n, COARSE_POINTS)
    enough = least * some // n
    total = _sum(task.levels[level], points[:some], (column, row), 1 << level, enough) * n // some
    total = min(total, bound)
    task.judged[0] += 1
    if total > least:
        push(queue, total, ((heading << _LEVEL | level) << _ROW | row) << _COLUMN | column)


@kernel
def _sum(level: Bytes, points: Ints32, first: tuple[int, int], block: int, least: int) -> int:
    """Return the sum of the points' likelihoods for the lidar in a block; 0 unless beyond `least`."""
    _, height, width = level.shape
    total, outside = 0, int(FULL * CHANCE)
    for i in range(len(points)):
        column, row = points[i, 1] + first[0], points[i, 2] + first[1]
        if -block < column < 0:  # the block reaches into the grid
            column = 0
        if -block < row < 0:
            row = 0
        if 0 <= column < width and 0 <= row < height:
            total += level[points[i, 0], row, column]
        else:
            total += outside
        if i & 7 == 7 and total + FULL * (len(points) - 1 - i) <= least:
            return 0
    return total


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
