"""The stretches of a line that are there: covered by more scans than see through them.

A line is looked at in cells. A wall ends where its cells are free, so that a wall with a door is two,
whatever a scan that grazed it took for one, and a closed door that opened for good is none.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.building.fusion import Fused
from impslam.building.groups import local
from impslam.building.sightings import Placed
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

CELL = 0.2  # m: a door of 0.8 m has three cells at least that do not touch its frame


@kernel
def cell_starts(fused: Fused) -> Ints:
    """Return (L + 1,) where the cells of each line begin."""
    out = np.zeros(len(fused.states) + 1, np.int64)
    for g in range(len(fused.states)):
        length = fused.extents[g, 1] - fused.extents[g, 0]
        out[g + 1] = out[g] + max(math.ceil(length / CELL), 1)
    return out


@kernel
def cell_places(fused: Fused, starts: Ints, is_line: bool) -> tuple[Array, Array]:
    """Return the middles (p, 2) of the cells and the lines' normals (p, 2) there, NaN for points."""
    places, normals = np.empty((starts[-1], 2)), np.full((starts[-1], 2), np.nan)
    for g in range(len(fused.states)):
        x, y, phi = fused.states[g]
        for p in range(starts[g], starts[g + 1]):
            places[p, 0], places[p, 1] = x, y
            if is_line:
                s = _middle(fused.extents[g], p - starts[g], starts[g + 1] - starts[g])
                places[p, 0] -= s * math.sin(phi)
                places[p, 1] += s * math.cos(phi)
                normals[p, 0], normals[p, 1] = math.cos(phi), math.sin(phi)
    return places, normals


@kernel
def _middle(extent: Array, cell: int, count: int) -> float:
    """Return where along a line the middle of a cell lies, m."""
    middle: float = extent[0] + (cell + 0.5) / count * (extent[1] - extent[0])
    return middle


@kernel
def covered(placed: Placed, index: Ints, fused: Fused, starts: Ints, is_line: bool) -> Ints:
    """Return how many sightings cover the middle of each cell, (p,)."""
    out, value, cov = np.zeros(starts[-1], np.int64), np.empty(2), np.empty(3)
    for i in range(len(index)):
        g = index[i]
        low, high = local(
            fused.states[g], placed.frames[i], placed.relative[i], is_line, value, cov
        )
        for p in range(starts[g], starts[g + 1]):
            middle = _middle(fused.extents[g], p - starts[g], starts[g + 1] - starts[g])
            if not is_line or low <= middle <= high:
                out[p] += 1
    return out


@kernel
def stretches(fused: Fused, starts: Ints, free: Ints) -> tuple[Array, Ints]:
    """Return the stretches (r, 2), m along their lines, between free cells, and where each line's begin.

    `free` (p,) is not 0 for cells that are free. A stretch reaches to the middle of the free cell
    beside it, or to infinity at a line's end; (L + 1,) is where the stretches of each line begin.
    """
    out, begin, count = np.empty((len(free), 2)), np.zeros(len(starts), np.int64), 0
    for g in range(len(starts) - 1):
        low, inside, n = -math.inf, False, starts[g + 1] - starts[g]
        for c in range(n):
            middle = _middle(fused.extents[g], c, n)
            if not free[starts[g] + c]:
                inside = True
            else:
                if inside:
                    out[count, 0], out[count, 1] = low, middle
                    count += 1
                low, inside = middle, False
        if inside:
            out[count, 0], out[count, 1] = low, math.inf
            count += 1
        begin[g + 1] = count
    return out[:count], begin


@kernel
def divide(
    placed: Placed, index: Ints, fused: Fused, runs: Array, begin: Ints, is_line: bool
) -> Ints:
    """Return the stretch (n,) that each sighting overlaps most, -1 for none; cut pieces to it.

    The frames of `placed` are changed: what reaches into free space is cut off.
    """
    out, value, cov = np.full(len(index), -1), np.empty(2), np.empty(3)
    for i in range(len(index)):
        g, most = index[i], 0.0
        frame = placed.frames[i]
        low, high = local(fused.states[g], frame, placed.relative[i], is_line, value, cov)
        for r in range(begin[g], begin[g + 1]):
            both = min(high, runs[r, 1]) - max(low, runs[r, 0])
            if both > most or not is_line:
                out[i], most = r, both
        if out[i] < 0 or not is_line:
            continue
        after, before = min(high, runs[out[i], 1]), max(low, runs[out[i], 0])
        if after - before < high - low:
            # The middle moves along the piece itself, whose covariance is moved with it.
            shift, c, s = (
                0.5 * (after + before - high - low),
                math.cos(frame[2]),
                math.sin(frame[2]),
            )
            frame[0] -= shift * s
            frame[1] += shift * c
            frame[3] = 0.5 * (after - before)
            for cov_of in (placed.relative[i], placed.whole[i]):
                cov_of[0] += shift * (shift * cov_of[2] - 2.0 * cov_of[1])
                cov_of[1] -= shift * cov_of[2]
    return out
