"""Group the sightings of each landmark, by Mahalanobis distance in map and by extent.

In order, each sighting joins the nearest group in the gate or starts a new one; afterwards, groups that
have grown together are joined. A grid of cells holds the groups by their first sighting, so that the time
grows with the groups nearby, not with all of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.building.groups import (
    HIGH,
    LOW,
    Rules,
    X,
    Y,
    as_sighting,
    begin,
    distance2,
    include,
    local,
)
from impslam.building.sightings import PlacedSightings, add_relief
from impslam.geometry.chi_square import GATE_2D
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

_JOIN_ROUNDS = 3  # a joined group may now match a third one
_PER_CELL = 16
"""Sightings in a cell, on average, at least: several are of one group."""
_SIZE, _REACH = 2, 3


class _Grid(NamedTuple):
    """Groups by the cell of their anchor: that of the first sighting.

    Attributes
    ----------
    groups : (n, 12) see `groups`
    newest : (nx, ny) the newest group in each cell, or -1
    older : (n,) the next older group in the same cell, or -1
    numbers : (4,) left and bottom edge, size of a cell, and largest extent of a group from its anchor, m
    """

    groups: Array
    newest: Ints
    older: Ints
    numbers: Array


@kernel
def _new_grid(frames: Array, margin: float) -> _Grid:
    """Return an empty grid for n sightings, in cells of at least `margin`, m."""
    n = len(frames)
    left, right = frames[:, 0].min(), frames[:, 0].max()
    bottom, top = frames[:, 1].min(), frames[:, 1].max()
    width, height = right - left, top - bottom
    size = max(margin, math.sqrt(_PER_CELL * width * height / n), _PER_CELL * (width + height) / n)
    cells = int(width / size) + 1, int(height / size) + 1
    numbers = np.array([left, bottom, size, 0.0])
    return _Grid(np.empty((n, 12)), np.full(cells, -1), np.full(n, -1), numbers)


@kernel
def _cells(grid: _Grid, axis: int, low: float, high: float) -> tuple[int, int]:
    """Return the first and the last cell along an axis that a stretch covers."""
    last, size = grid.newest.shape[axis] - 1, grid.numbers[_SIZE]
    first = int(min(max((low - grid.numbers[axis]) / size, 0.0), last))
    return first, int(min(max((high - grid.numbers[axis]) / size, 0.0), last))


@kernel
def _enter(grid: _Grid, g: int) -> None:
    """Enter group g in its cell."""
    x, y = grid.groups[g, X], grid.groups[g, Y]
    i, j = _cells(grid, 0, x, x)[0], _cells(grid, 1, y, y)[0]
    grid.older[g], grid.newest[i, j] = grid.newest[i, j], g
    _lengthen(grid, g)


@kernel
def _lengthen(grid: _Grid, g: int) -> None:
    """Record the extent of group g."""
    group = grid.groups[g]
    grid.numbers[_REACH] = max(grid.numbers[_REACH], group[HIGH], -group[LOW])


@kernel
def _nearest(
    grid: _Grid,
    below: int,
    frame: Array,
    cov: Array,
    extra: Array,
    rules: Rules,
    excluded: Mask,
) -> int:
    """Return the nearest group in the gate of a sighting, or -1; only those `below`, not excluded (n,)."""
    best, nearest, scratch = -1, GATE_2D, np.empty((3, 3))
    radius = frame[3] + rules.gap + 1.0
    span = radius + grid.numbers[_REACH]
    left, right = _cells(grid, 0, frame[0] - span, frame[0] + span)
    bottom, top = _cells(grid, 1, frame[1] - span, frame[1] + span)
    for i in range(left, right + 1):
        for j in range(bottom, top + 1):
            g = grid.newest[i, j]
            while g >= 0:
                group = grid.groups[g]
                dx, dy = frame[0] - group[X], frame[1] - group[Y]
                limit = radius + max(group[HIGH], -group[LOW])
                if g < below and not excluded[g] and dx * dx + dy * dy <= limit * limit:
                    d2 = distance2(group, frame, cov, extra, rules, scratch)
                    if d2 < nearest or (d2 == nearest and g < best):
                        best, nearest = g, d2
                g = grid.older[g]
    return best


@kernel
def _labelled(labels: Ints, first: Ints, label: int, excluded: Mask) -> int:
    """Return the group of a label, or -1, and exclude the groups of other labels."""
    for g in range(len(first)):
        if labels[first[g]] == label:
            return g
        excluded[g] = excluded[g] or labels[first[g]] >= 0
    return -1


@kernel
def _join(grid: _Grid, extra: Array, parents: Ints, rules: Rules) -> bool:
    """Join groups that have grown together with the first of them; return whether any were.

    `extra` (m, 3) is as in `associate`, for each group; `parents` (m,) is the group that each belongs to.
    """
    frame, cov, value, any_joined = np.empty(4), np.empty(3), np.empty(2), False
    groups, moved, joined = grid.groups, np.empty(3), parents != np.arange(len(parents))
    for j in range(1, len(parents)):
        if joined[j]:
            continue
        as_sighting(groups[j], rules.is_line, frame, cov)
        add_relief(cov, 2.0 * frame[3], rules.relief)
        i = _nearest(grid, j, frame, cov, extra[j], rules, joined)
        if i >= 0:
            parents[j], joined[j], any_joined = i, True, True
            low, high = local(groups[i, :3], frame, cov, rules.is_line, value, moved)
            include(groups[i], value, moved, low, high)
            _lengthen(grid, i)
    return any_joined


@kernel
def _roots(parents: Ints) -> Ints:
    """Return the group (m,) that each group belongs to in the end; a parent has a lower number."""
    roots = parents.copy()
    for g in range(len(roots)):
        roots[g] = roots[roots[g]]
    return roots


@kernel
def associate(
    placed: PlacedSightings, keyframes: Ints, labels: Ints, extra: Array, rules: Rules
) -> Ints:
    """Return the group (n,) of each sighting: the row of the group's first sighting.

    `extra` (n, 3) is the covariance that the keyframes of the group add. Sightings with the same label are
    one landmark, those with different labels are not. A scan shows a point landmark once.
    """
    n, grid = len(keyframes), _new_grid(placed.frames, rules.gap + 1.0)
    groups, first, out, count, newest = (
        grid.groups,
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        0,
        0,
    )
    value, cov, excluded = np.empty(2), np.empty(3), np.zeros(n, np.bool_)
    for i in range(n):
        if keyframes[i] != keyframes[newest]:
            excluded[out[newest:i]] = False
            newest = i
        frame, seen, best, apart = placed.frames[i], placed.relative[i], -1, excluded
        if labels[i] >= 0:
            apart = excluded.copy()
            best = _labelled(labels, first[:count], labels[i], apart)
        if best < 0:
            best = _nearest(grid, count, frame, seen, extra[i], rules, apart)
        if best < 0:
            best, count = count, count + 1
            first[best] = i
            begin(groups[best], frame, seen)
            _enter(grid, best)
        else:
            low, high = local(groups[best, :3], frame, seen, rules.is_line, value, cov)
            include(groups[best], value, cov, low, high)
            _lengthen(grid, best)
        excluded[best], out[i] = not rules.is_line, best
    parents = np.arange(count)
    if labels.max() < 0:
        for _ in range(_JOIN_ROUNDS):
            if not _join(grid, extra[first[:count]], parents, rules):
                break
    return first[_roots(parents)[out]]
