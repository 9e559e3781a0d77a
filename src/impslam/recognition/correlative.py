"""Correlative scan matching: the pose in a window where points fit a likelihood grid best.

A grid holds how likely a point falls on each cell: a Gaussian around the reference's points. The score
of a pose is the mean likelihood of the points there (Olson 2009, Eq. 5, with the sum for the
product). Poses are sought on the grid's own raster and at a fixed step of heading by branch and bound
(Hess et al. 2016, Alg. 3): level l of the pyramid holds the greatest likelihood among 2^l x 2^l cells,
so that one sum bounds the scores of as many poses. The result is that of an exhaustive search.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap, wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.recognition.pyramid import CELL, FULL, Bytes, Ints32, Pyramid
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

TURN = 0.0125  # rad between two headings: a point 8 m away moves by one cell
APART, TURNED = 0.8, 0.25  # m, rad: peaks farther apart are two places, not one blurred
DEEPEST = 6  # levels: blocks of 64 cells


class Window(NamedTuple):
    """Half the extent of a search around its guess, in m along both axes of the map, and in rad."""

    x: float
    y: float
    heading: float


class Peak(NamedTuple):
    """The best pose (3,) of a search, and its score from 0 (nothing found) to 1."""

    score: float
    pose: Array


def deep_enough(window: Window) -> int:
    """Return the level at which to begin a search: blocks of about a quarter of the window."""
    cells = 2.0 * max(window.x, window.y) / CELL
    return int(np.clip(round(math.log2(max(cells, 1.0))) - 2, 3, DEEPEST))


def search(
    pyramid: Pyramid,
    points: Features,
    guess: Array,
    window: Window,
    min_score: float = 0.0,
    exclude: Array | None = None,
    turn: float = TURN,
) -> Peak:
    """Return the best pose in a window around a guess (3,); score 0 unless one exceeds `min_score`.

    Parameters
    ----------
    points : (n, 2 or more columns) x, y in m in the frame whose pose is sought
    exclude : a pose (3,): those within `APART` and `TURNED` of it are left out
    turn : rad, step between headings; a window of pi or more is all around in equal steps
    """
    headings = guess[2] + _turns(window.heading, turn)
    reach = np.array([math.ceil(window.x / CELL - 1e-9), math.ceil(window.y / CELL - 1e-9)])
    least = math.floor(min_score * FULL * len(points))
    apart = 0.0 if exclude is None else APART / CELL
    other = plain(guess if exclude is None else exclude)
    elsewhere = (other[:2] - guess[:2]) / CELL, float(other[2]), apart
    ordered = np.ascontiguousarray(points[spread(len(points))])
    total, a, u, v = _search(pyramid, ordered, plain(guess), headings, reach, least, elsewhere)
    if a < 0:
        return Peak(0.0, np.array(guess))
    heading = float(wrap(headings[a]))
    pose = np.array([guess[0] + u * CELL, guess[1] + v * CELL, heading])
    return Peak(total / (FULL * len(points)), pose)


def spread(n: int) -> Ints:
    """Return 0 to n - 1 in an order whose every beginning is spread over all: so that sums end early."""
    step = max(1, round(0.618 * n))  # the golden section: multiples of it fill a circle evenly
    while math.gcd(step, n) > 1:
        step += 1
    return np.arange(n) * step % n


def _turns(half: float, step: float) -> Array:
    """Return headings (a,) relative to the guess, no farther than `step` from one to the next."""
    if half >= math.pi:
        n = math.ceil(2.0 * math.pi / step)
        return plain(np.arange(n) * (2.0 * math.pi / n))
    n = math.ceil(half / step - 1e-9)
    return plain(np.arange(-n, n + 1) * step)


@kernel
def _search(
    pyramid: Pyramid,
    points: Features,
    guess: Array,
    headings: Array,
    reach: Ints,
    least: int,
    elsewhere: tuple[Array, float, float],
) -> tuple[int, int, int, int]:
    """Return the best sum of likelihoods, and where: index of the heading and shift in cells.

    `reach` (2,) is the greatest shift; only sums beyond `least` count, the index is -1 where there is
    none. `elsewhere` is a shift (2,), a heading in rad and a radius in cells to leave out.
    """
    centre, heading, radius = elsewhere
    columns, rows = _cells(pyramid, points, guess, headings)
    starts = _bounds(pyramid, columns, rows, reach, least)
    block = 1 << (len(pyramid.levels) - 1)
    wide, high = 2 * reach[0] // block + 1, 2 * reach[1] // block + 1
    best, at, u, v = least, -1, 0, 0
    first = np.argmax(starts)
    order = np.full(1, first)
    for turn in range(2):  # the likeliest block; then those left that may hold a better pose
        if turn == 1:
            order = np.flatnonzero(starts > best)
            order = order[np.argsort(-starts[order], kind="mergesort")]
        for k in order:
            if starts[k] <= best or (turn == 1 and k == first):
                continue
            a = k // (wide * high)
            node = np.array(
                [
                    len(pyramid.levels) - 1,
                    (k % wide) * block - reach[0],
                    (k // wide % high) * block - reach[1],
                    starts[k],
                ]
            )
            r = radius if abs(wrap_in_kernel(headings[a] - heading)) < TURNED else 0.0
            total, x, y = _descend(
                pyramid.levels, columns[a], rows[a], reach, node, best, (centre, r)
            )
            if total > best:
                best, at, u, v = total, a, x, y
    return best, at, u, v


@kernel
def _cells(
    pyramid: Pyramid, points: Features, guess: Array, headings: Array
) -> tuple[Ints32, Ints32]:
    """Return the columns and rows (a, n) of the points at the guess turned to each heading."""
    columns = np.empty((len(headings), len(points)), np.int32)
    rows = np.empty_like(columns)
    x0, y0 = guess[0] - pyramid.corner[0], guess[1] - pyramid.corner[1]
    for a in range(len(headings)):
        c, s = math.cos(headings[a]), math.sin(headings[a])
        for i in range(len(points)):
            x, y = points[i, 0], points[i, 1]
            columns[a, i] = math.floor((x0 + c * x - s * y) / CELL)
            rows[a, i] = math.floor((y0 + s * x + c * y) / CELL)
    return columns, rows


@kernel
def _bounds(pyramid: Pyramid, columns: Ints32, rows: Ints32, reach: Ints, least: int) -> Ints32:
    """Return the bounds of the blocks that a search begins with, by heading, row and column."""
    top = len(pyramid.levels) - 1
    block = 1 << top
    wide, high = 2 * reach[0] // block + 1, 2 * reach[1] // block + 1
    bounds = np.empty(len(columns) * wide * high, np.int32)
    k = 0
    for a in range(len(columns)):
        for row in range(high):
            for column in range(wide):
                u, v = column * block - reach[0], row * block - reach[1]
                bounds[k] = _sum(pyramid.levels[top], columns[a], rows[a], u, v, least)
                k += 1
    return bounds


@kernel
def _sum(level: Bytes, columns: Ints32, rows: Ints32, u: int, v: int, least: int) -> int:
    """Return the sum over the points moved by a shift; less, once it cannot exceed `least`."""
    height, width = level.shape
    total, left = 0, FULL * len(columns)
    for i in range(len(columns)):
        c, r = columns[i] + u, rows[i] + v
        left -= FULL
        if 0 <= c < width and 0 <= r < height:
            total += level[r, c]
        if i & 15 == 15 and total + left <= least:
            break
    return total


@kernel
def _descend(
    levels: Bytes,
    columns: Ints32,
    rows: Ints32,
    reach: Ints,
    node: Ints,
    best: int,
    elsewhere: tuple[Array, float],
) -> tuple[int, int, int]:
    """Return the best sum beyond `best` in a block, and its shift; the likeliest quarter first.

    `node` (4,) is a block: its level, its first shift u, v, and its bound.
    """
    stack = np.empty((3 * len(levels) + 4, 4), np.int64)
    stack[0] = node
    size, u, v = 1, 0, 0
    while size > 0:
        size -= 1
        level, x, y, bound = stack[size]
        if bound <= best or _covered(x, y, 1 << level, elsewhere):
            continue
        if level == 0:
            best, u, v = bound, x, y
            continue
        first, half = size, 1 << (level - 1)
        for quarter in range(4):
            cx, cy = x + (quarter & 1) * half, y + (quarter >> 1) * half
            if cx > reach[0] or cy > reach[1]:
                continue
            bound = _sum(levels[level - 1], columns, rows, cx, cy, best)
            if bound > best:
                _push(stack, first, size, (level - 1, cx, cy, bound))
                size += 1
    return best, u, v


@kernel
def _push(stack: Ints, first: int, size: int, node: tuple[int, int, int, int]) -> None:
    """Insert a node into `stack[first:size]`, whose bounds rise."""
    k = size
    while k > first and stack[k - 1, 3] > node[3]:
        stack[k] = stack[k - 1]
        k -= 1
    stack[k, 0], stack[k, 1], stack[k, 2], stack[k, 3] = node


@kernel
def _covered(u: int, v: int, block: int, elsewhere: tuple[Array, float]) -> bool:
    """Tell whether all shifts of a block lie in a disc."""
    centre, radius = elsewhere
    x = max(abs(u - centre[0]), abs(u + block - 1 - centre[0]))
    y = max(abs(v - centre[1]), abs(v + block - 1 - centre[1]))
    return bool(x * x + y * y < radius * radius)
