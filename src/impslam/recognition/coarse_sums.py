"""Sums of likelihoods of points, for all headings and all blocks of a map in which the lidar may be.

From one block of a row to the next, a point also moves by one block. With the cells that are a block apart
side by side in memory, the sums of a run of blocks are sums of contiguous lines, which compilers vectorise.
All sums together are then faster than a tree search that leaves most of them out.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.recognition.pyramid import CELL, Bytes, Ints32
from impslam.types import Ints

Sums: TypeAlias = np.ndarray[Any, np.dtype[np.uint16]]

LEVEL = 2  # of the pyramid
BLOCK = 1 << LEVEL  # cells, 0.4 m
REACH = 24.0  # m from the lidar to the farthest point
_PAD = round(REACH / (BLOCK * CELL))  # blocks of unknown space beside the map
MAX_GAP = 4  # blocks between two runs that are joined: a run costs as much as some blocks
MAX_POINTS = 256  # whose sum fits


def lines(level: Bytes, unknown: int) -> Bytes:
    """Return the lines (..., h, BLOCK, w / BLOCK + 2 _PAD) of a level (..., h, w) of the pyramid.

    Line k of a row has its columns k, k + BLOCK, ... between cells in unknown space.
    """
    *shape, width = level.shape
    blocks = -(-width // BLOCK)
    out = np.full((*shape, BLOCK, blocks + 2 * _PAD), unknown, np.uint8)
    for k in range(BLOCK):
        columns = level[..., k::BLOCK]
        out[..., k, _PAD : _PAD + columns.shape[-1]] = columns
    return out


@kernel
def runs_of(allowed: Bytes) -> Ints:
    """Return the runs (k, 4) of allowed blocks; they may include a few that are not.

    A run consists of the row of its lower cells, its first block, the number of blocks, and the number of
    those in the runs before it.

    Parameters
    ----------
    allowed : (h, w) 1 if the lidar may be anywhere in the block from a cell upwards and to the right
    """
    height, width = allowed.shape
    runs = np.empty((((height - 1) // BLOCK + 1) * ((width - 1) // BLOCK + 1), 4), np.int64)
    number, total = 0, 0
    for row in range(0, height, BLOCK):
        last = -MAX_GAP - 2
        for block in range((width - 1) // BLOCK + 1):
            if not allowed[row, block * BLOCK]:
                continue
            if block - last > MAX_GAP + 1:
                runs[number] = row, block, 0, total
                number += 1
                last = block - 1
            runs[number - 1, 2] += block - last
            total += block - last
            last = block
    return runs[:number].copy()


@kernel
def coarse_sums(grid: Bytes, allowed: Bytes, runs: Ints, rotated: Ints32) -> Sums:
    """Return the sums (headings, blocks of all runs) of maximum likelihoods; 0 in blocks not allowed.

    Parameters
    ----------
    grid : (DIRECTIONS + 1, h, BLOCK, w / BLOCK + 2 _PAD), see `lines`; its first and last row are unknown
    allowed, runs : see `runs_of`
    rotated : (headings, n, 3) direction, column and row of up to `MAX_POINTS` points within `REACH`
    """
    _, height, _, width = grid.shape
    cells, n = grid.ravel(), rotated.shape[1]
    at = np.empty(n, np.uint64)  # unsigned, or else each index is tested for being negative
    sums = np.zeros((len(rotated), runs[:, 2].sum()), np.uint16)
    for row, first, count, before in runs:
        for a in range(len(rotated)):
            for i in range(n):
                direction, x, y = rotated[a, i]
                line = (direction * height + min(max(row + y, 0), height - 1)) * BLOCK
                at[i] = (line + (x & (BLOCK - 1))) * width + _PAD + first + (x >> LEVEL)
            out = sums[a, before : before + count]
            _add_lines(out, cells, at)
            for k in range(count):
                if not allowed[row, (first + k) * BLOCK]:
                    out[k] = 0
    return sums


@kernel
def _add_lines(out: Sums, cells: Bytes, at: Ints) -> None:
    """Add the lines of cells that begin at indices; four at a time, since `out` is read and written."""
    n = len(at) // 4 * 4
    for i in range(0, n, 4):
        a, b, c, d = at[i], at[i + 1], at[i + 2], at[i + 3]
        for k in range(np.uint64(len(out))):
            total = np.uint16(cells[a + k]) + cells[b + k]
            total += np.uint16(cells[c + k]) + cells[d + k]
            out[k] += np.uint16(total)
    for i in range(n, len(at)):
        for k in range(np.uint64(len(out))):
            out[k] += cells[at[i] + k]
