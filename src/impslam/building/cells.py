"""Split lines at free space: keep the stretches that more scans cover than see through.

A line is divided into cells. A wall ends at its free cells, so that a wall with a door becomes two, even if
a scan at a grazing angle took it for one, and a door that has been opened for good is removed.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.building.fusion import Fused
from impslam.building.groups import local
from impslam.building.sightings import PlacedSightings
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

CELL = 0.2  # m: a door of 0.8 m has at least three cells that do not touch its frame


@kernel
def cell_starts(fused: Fused) -> Ints:
    """Return the index (L + 1,) of the first cell of each line."""
    out = np.zeros(len(fused.states) + 1, np.int64)
    for g in range(len(fused.states)):
        length = fused.extents[g, 1] - fused.extents[g, 0]
        out[g + 1] = out[g] + max(math.ceil(length / CELL), 1)
    return out


@kernel
def cell_centres(fused: Fused, starts: Ints, is_line: bool) -> tuple[Array, Array]:
    """Return the centres (p, 2) of the cells and the normals (p, 2) of their lines, NaN for points."""
    centres, normals = np.empty((starts[-1], 2)), np.full((starts[-1], 2), np.nan)
    for g in range(len(fused.states)):
        x, y, phi = fused.states[g]
        for p in range(starts[g], starts[g + 1]):
            centres[p, 0], centres[p, 1] = x, y
            if is_line:
                s = _middle(fused.extents[g], p - starts[g], starts[g + 1] - starts[g])
                centres[p, 0] -= s * math.sin(phi)
                centres[p, 1] += s * math.cos(phi)
                normals[p, 0], normals[p, 1] = math.cos(phi), math.sin(phi)
    return centres, normals


@kernel
def _middle(extent: Array, cell: int, count: int) -> float:
    """Return the position of the middle of a cell along its line, m."""
    middle: float = extent[0] + (cell + 0.5) / count * (extent[1] - extent[0])
    return middle


@kernel
def count_covering(
    placed: PlacedSightings, index: Ints, fused: Fused, starts: Ints, is_line: bool
) -> Ints:
    """Return the number (p,) of sightings that cover the middle of each cell."""
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
    """Return the stretches (r, 2) between free cells, m along their lines, and the first (L + 1,) of each.

    `free` (p,) is not 0 for free cells. A stretch extends to the middle of the adjacent free cell, or to
    infinity at the end of a line.
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
    placed: PlacedSightings, index: Ints, fused: Fused, runs: Array, begin: Ints, is_line: bool
) -> Ints:
    """Return the stretch (n,) with the largest overlap with each sighting, -1 for none.

    Modifies `placed`: parts of pieces in free space are cut off.
    """
    out, value, cov = np.full(len(index), -1), np.empty(2), np.empty(3)
    for i in range(len(index)):
        g, largest = index[i], 0.0
        frame = placed.frames[i]
        low, high = local(fused.states[g], frame, placed.relative[i], is_line, value, cov)
        for r in range(begin[g], begin[g + 1]):
            overlap = min(high, runs[r, 1]) - max(low, runs[r, 0])
            if overlap > largest or not is_line:
                out[i], largest = r, overlap
        if out[i] < 0 or not is_line:
            continue
        end, start = min(high, runs[out[i], 1]), max(low, runs[out[i], 0])
        if end - start < high - low:
            # Move the middle along the piece, and propagate the covariance.
            c, s = math.cos(frame[2]), math.sin(frame[2])
            shift = 0.5 * (end + start - high - low)
            frame[0] -= shift * s
            frame[1] += shift * c
            frame[3] = 0.5 * (end - start)
            for moved in (placed.relative[i], placed.whole[i]):
                moved[0] += shift * (shift * moved[2] - 2.0 * moved[1])
                moved[1] -= shift * moved[2]
    return out
