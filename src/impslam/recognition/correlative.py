"""Correlative scan matching: the pose in a window at which points fit a likelihood grid best.

Each cell of the grid holds the likelihood of a point there: a Gaussian around the points of the reference.
The score of a pose is the mean likelihood of the points (Olson 2009, Eq. 5, with a sum instead of the
product). Poses on the raster of the grid, with a fixed step of heading, are searched by branch and bound
(Hess et al. 2016, Alg. 3): level l of the pyramid holds the maximum likelihood of 2^l x 2^l cells, so that
one sum bounds the scores of as many poses. The result is that of an exhaustive search.

Only the score of a single pose takes into account which side of a surface a point is on. The bounds do not:
they are bounds of that score, too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap, wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.recognition.pyramid import (
    CELL,
    DIRECTIONS,
    FULL,
    Bytes,
    Ints32,
    Pyramid,
    direction_of,
)
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

HEADING_STEP = 0.0125  # rad: a point 8 m away moves by one cell
SEPARATION, HEADING_SEPARATION = 0.8, 0.25  # m, rad: peaks farther apart are distinct places
MAX_LEVEL = 6  # blocks of 64 cells


class Window(NamedTuple):
    """Half the extent of a search around its guess, in m along both axes of the map, and in rad."""

    x: float
    y: float
    heading: float


class _Rotated(NamedTuple):
    """Points (a, n) at the guess, rotated to each heading: columns, rows, and directions of normals."""

    columns: Ints32
    rows: Ints32
    directions: Ints32


class Peak(NamedTuple):
    """The best pose (3,) of a search, and its score from 0 (nothing found) to 1."""

    score: float
    pose: Array


def start_level(window: Window) -> int:
    """Return the pyramid level at which a search starts: blocks of about a quarter of the window."""
    cells = 2.0 * max(window.x, window.y) / CELL
    return int(np.clip(round(math.log2(max(cells, 1.0))) - 2, 3, MAX_LEVEL))


def search(
    pyramid: Pyramid,
    points: Features,
    guess: Array,
    window: Window,
    min_score: float = 0.0,
    exclude: Array | None = None,
    turn: float = HEADING_STEP,
) -> Peak:
    """Return the best pose in a window around a guess (3,), with score 0 if none exceeds `min_score`.

    Parameters
    ----------
    points : features (n, 5) in the frame to be located
    exclude : a pose (3,); poses within `SEPARATION` and `HEADING_SEPARATION` of it are excluded
    turn : rad, step between headings; a window of pi or more is a full circle in equal steps
    """
    headings = guess[2] + _turns(window.heading, turn)
    max_shift = np.array([math.ceil(window.x / CELL - 1e-9), math.ceil(window.y / CELL - 1e-9)])
    min_sum = math.floor(min_score * FULL * len(points))
    radius = 0.0 if exclude is None else SEPARATION / CELL
    other = plain(guess if exclude is None else exclude)
    excluded = (other[:2] - guess[:2]) / CELL, float(other[2]), radius
    ordered = np.ascontiguousarray(points[spread_order(len(points))])
    total, a, u, v = _search(pyramid, ordered, plain(guess), headings, max_shift, min_sum, excluded)
    if a < 0:
        return Peak(0.0, np.array(guess))
    heading = float(wrap(headings[a]))
    pose = np.array([guess[0] + u * CELL, guess[1] + v * CELL, heading])
    return Peak(total / (FULL * len(points)), pose)


def spread_order(n: int) -> Ints:
    """Return 0 to n - 1 in an order whose every prefix is spread evenly, so that sums can end early."""
    step = max(1, round(0.618 * n))  # the golden section: multiples of it fill a circle evenly
    while math.gcd(step, n) > 1:
        step += 1
    return np.arange(n) * step % n


def _turns(half: float, step: float) -> Array:
    """Return headings (a,) relative to the guess, at most `step` apart."""
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
    max_shift: Ints,
    min_sum: int,
    excluded: tuple[Array, float, float],
) -> tuple[int, int, int, int]:
    """Return the best sum of likelihoods, with its index of the heading and shift in cells.

    `max_shift` (2,) is in cells. The index is -1 if no sum exceeds `min_sum`. `excluded` is a disc of
    shifts to exclude: centre (2,), heading in rad and radius in cells.
    """
    centre, heading, radius = excluded
    rotated = _rotate(pyramid, points, guess, headings)
    starts = _bounds(pyramid, rotated, max_shift, min_sum)
    block = 1 << (len(pyramid.levels) - 1)
    wide, high = 2 * max_shift[0] // block + 1, 2 * max_shift[1] // block + 1
    best, at, u, v = min_sum, -1, 0, 0
    first = np.argmax(starts)
    order = np.full(1, first)
    for phase in range(2):  # the likeliest block; then the others that may contain a better pose
        if phase == 1:
            order = np.flatnonzero(starts > best)
            order = order[np.argsort(-starts[order], kind="mergesort")]
        for k in order:
            if starts[k] <= best or (phase == 1 and k == first):
                continue
            a = k // (wide * high)
            node = np.array(
                [
                    len(pyramid.levels) - 1,
                    (k % wide) * block - max_shift[0],
                    (k // wide % high) * block - max_shift[1],
                    starts[k],
                ]
            )
            r = radius if abs(wrap_in_kernel(headings[a] - heading)) < HEADING_SEPARATION else 0.0
            total, x, y = _descend(pyramid, rotated, a, max_shift, node, best, (centre, r))
            if total > best:
                best, at, u, v = total, a, x, y
    return best, at, u, v


@kernel
def _rotate(pyramid: Pyramid, points: Features, guess: Array, headings: Array) -> _Rotated:
    """Return features (n, 5) at the guess, rotated to each heading."""
    columns = np.empty((len(headings), len(points)), np.int32)
    rows, directions = np.empty_like(columns), np.empty_like(columns)
    x0, y0 = guess[0] - pyramid.corner[0], guess[1] - pyramid.corner[1]
    for a in range(len(headings)):
        c, s = math.cos(headings[a]), math.sin(headings[a])
        for i in range(len(points)):
            x, y, nx, ny, weight = points[i]
            columns[a, i] = math.floor((x0 + c * x - s * y) / CELL)
            rows[a, i] = math.floor((y0 + s * x + c * y) / CELL)
            directions[a, i] = direction_of(c * nx - s * ny, s * nx + c * ny, weight)
    return _Rotated(columns, rows, directions)


@kernel
def _bounds(pyramid: Pyramid, rotated: _Rotated, max_shift: Ints, min_sum: int) -> Ints32:
    """Return the bounds of the initial blocks of a search, by heading, row and column."""
    top = len(pyramid.levels) - 1
    block = 1 << top
    wide, high = 2 * max_shift[0] // block + 1, 2 * max_shift[1] // block + 1
    bounds = np.empty(len(rotated.columns) * wide * high, np.int32)
    k = 0
    for a in range(len(rotated.columns)):
        columns, rows = rotated.columns[a], rotated.rows[a]
        for row in range(high):
            for column in range(wide):
                u, v = column * block - max_shift[0], row * block - max_shift[1]
                bounds[k] = _sum(pyramid.levels[top], columns, rows, u, v, min_sum)
                k += 1
    return bounds


@kernel
def _sum(level: Bytes, columns: Ints32, rows: Ints32, u: int, v: int, min_sum: int) -> int:
    """Return the sum over the shifted points; a partial sum once it cannot exceed `min_sum`."""
    height, width = level.shape
    total, remaining = 0, FULL * len(columns)
    for i in range(len(columns)):
        c, r = columns[i] + u, rows[i] + v
        remaining -= FULL
        if 0 <= c < width and 0 <= r < height:
            total += int(level[r, c])
        if i & 15 == 15 and total + remaining <= min_sum:
            break
    return total


@kernel
def _score(pyramid: Pyramid, rotated: _Rotated, a: int, u: int, v: int) -> int:
    """Return the sum over the points of heading a, shifted: of their likelihoods on their own sides."""
    _, height, width = pyramid.facing.shape
    total = 0
    for i in range(rotated.columns.shape[1]):
        c, r = rotated.columns[a, i] + u, rotated.rows[a, i] + v
        if 0 <= c < width and 0 <= r < height:
            direction = rotated.directions[a, i]
            known = direction < DIRECTIONS
            total += int(pyramid.facing[direction, r, c] if known else pyramid.levels[0, r, c])
    return total


@kernel
def _descend(
    pyramid: Pyramid,
    rotated: _Rotated,
    a: int,
    max_shift: Ints,
    node: Ints,
    best: int,
    excluded: tuple[Array, float],
) -> tuple[int, int, int]:
    """Return the best sum beyond `best` in a block, and its shift; search the likeliest quarter first.

    The points are those of heading `a`. `node` (4,) is a block: its level, its first shift u, v, and its
    bound.
    """
    levels, columns, rows = pyramid.levels, rotated.columns[a], rotated.rows[a]
    stack = np.empty((3 * len(levels) + 4, 4), np.int64)
    stack[0] = node
    size, u, v = 1, 0, 0
    while size > 0:
        size -= 1
        level, x, y, bound = stack[size]
        if bound <= best or _is_excluded(x, y, 1 << level, excluded):
            continue
        if level == 0:
            total = _score(pyramid, rotated, a, x, y)
            if total > best:
                best, u, v = total, x, y
            continue
        first, half = size, 1 << (level - 1)
        for quarter in range(4):
            cx, cy = x + (quarter & 1) * half, y + (quarter >> 1) * half
            if cx > max_shift[0] or cy > max_shift[1]:
                continue
            bound = _sum(levels[level - 1], columns, rows, cx, cy, best)
            if bound > best:
                _push(stack, first, size, (level - 1, cx, cy, bound))
                size += 1
    return best, u, v


@kernel
def _push(stack: Ints, first: int, size: int, node: tuple[int, int, int, int]) -> None:
    """Insert a node into `stack[first:size]`, which is sorted by ascending bound."""
    k = size
    while k > first and stack[k - 1, 3] > node[3]:
        stack[k] = stack[k - 1]
        k -= 1
    stack[k, 0], stack[k, 1], stack[k, 2], stack[k, 3] = node


@kernel
def _is_excluded(u: int, v: int, block: int, excluded: tuple[Array, float]) -> bool:
    """Return whether all shifts of a block are in the excluded disc."""
    centre, radius = excluded
    x = max(abs(u - centre[0]), abs(u + block - 1 - centre[0]))
    y = max(abs(v - centre[1]), abs(v + block - 1 - centre[1]))
    return bool(x * x + y * y < radius * radius)
