"""An occupancy grid: what is free, what is occupied, what nobody has looked at.

Each cell holds the log-odds of being occupied (Moravec & Elfes 1985; Thrun et al. 2005, Eq. 9.7).
A scan changes a cell once at most, and a beam's end outweighs beams that pass: otherwise the many
beams that graze a wall would wipe it out.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask, Scan

HIT = math.log(0.7 / 0.3)
"""A beam ends here. With 2 cm of range noise the end falls in its own cell of 5 cm in 7 of 10."""
MISS = math.log(0.3 / 0.7)
"""A beam passes here. Counts like an end, so that what moved away is forgotten as fast as it was
learnt; two passes make a cell free in a trinary map (p < 0.196)."""
CLAMP = math.log(0.97 / 0.03)
"""Certainty ends here (Hornung et al. 2013, 4.1), or the map could not follow a changed world."""
STILL = (0.01, math.radians(0.2))
"""m and rad: less motion than this since the last scan entered is standing still."""
STILL_SCANS = 5
"""Scans entered at a standstill; further ones share their errors and teach nothing new."""
MARGIN = 64
"""Cells kept free around what is known, so that the grid seldom grows."""
MAX_CELLS = 40_000_000
"""Beyond 100 000 m^2 at 5 cm (320 MB) a pose has run away; its beams are refused."""

Floats: TypeAlias = npt.NDArray[np.float32]
Stamps: TypeAlias = npt.NDArray[np.int32]


@kernel
def place(pose: Array, origins: Array, points: Array, valid: Mask, size: float) -> Array:
    """Return the valid beams' cells in map, (n, 4): columns and rows of start and end."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    cells = np.empty((len(valid), 4))
    n = 0
    for i in range(len(valid)):
        if not valid[i]:
            continue
        for j, p in ((0, origins[i]), (2, points[i])):
            cells[n, j] = math.floor((pose[0] + c * p[0] - s * p[1]) / size)
            cells[n, j + 1] = math.floor((pose[1] + s * p[0] + c * p[1]) / size)
        n += 1
    return cells[:n]


@kernel
def sound(cells: Array) -> tuple[Array, Array]:
    """Return the beams that end somewhere on Earth, and the box (4,) low and high they reach."""
    box = np.array([math.inf, math.inf, -math.inf, -math.inf])
    n = 0
    for i in range(len(cells)):
        reach = max(abs(cells[i, 0]), abs(cells[i, 1])) + max(abs(cells[i, 2]), abs(cells[i, 3]))
        if reach < MAX_CELLS:  # false where not finite
            cells[n] = cells[i]
            for j in range(4):
                box[j % 2] = min(box[j % 2], cells[i, j])
                box[2 + j % 2] = max(box[2 + j % 2], cells[i, j])
            n += 1
    return cells[:n], box


@kernel
def trace(logodds: Floats, last: Stamps, scan: int, beams: Ints) -> None:
    """Enter beams (n, 4), cell to cell; `last` is the scan that changed a cell last.

    Between its cells a beam goes by one cell a step along its longer side (Bresenham 1965), in
    fixed point with 32 binary digits: without a branch to guess wrong, three times as fast as the
    exact traversal of Amanatides & Woo 1987, whose extra cells the next beam enters anyway.
    """
    width, half = logodds.shape[1], np.int64(1) << 31
    cells, changed = logodds.reshape(-1), last.reshape(-1)
    for i in range(len(beams)):
        cell = beams[i, 3] * width + beams[i, 2]
        if changed[cell] != scan:
            changed[cell] = scan
            cells[cell] = min(cells[cell] + HIT, CLAMP)
    for i in range(len(beams)):
        dx, dy = beams[i, 2] - beams[i, 0], beams[i, 3] - beams[i, 1]
        steps = max(abs(dx), abs(dy), 1)
        step_x, step_y = (dx << 32) // steps, (dy << 32) // steps
        x, y = (beams[i, 0] << 32) + half, (beams[i, 1] << 32) + half
        for _ in range(steps):
            cell = np.uint64(
                (y >> 32) * width + (x >> 32)
            )  # unsigned: no test for a negative index
            if changed[cell] != scan:
                changed[cell] = scan
                cells[cell] = max(cells[cell] + MISS, -CLAMP)
            x += step_x
            y += step_y


class OccupancyGrid:
    """Grows where the beams reach; cell (0, 0) is the lower-left one.

    Attributes
    ----------
    logodds : (rows, columns) float32, 0 where nothing is known
    corner : (2,) column and row of cell (0, 0), counted from the origin of map
    refused : beams that were not entered: not finite, or too far away to be true
    """

    def __init__(self, resolution: float = 0.05) -> None:
        self.resolution = resolution
        self.logodds: Floats = np.zeros((0, 0), np.float32)
        self.corner: Ints = np.zeros(2, np.int64)
        self.refused = 0
        self._last: Stamps = np.zeros((0, 0), np.int32)
        self._scans = 0
        self._pose: Array | None = None
        self._still = 0

    def enter(self, pose: Array, scan: Scan) -> None:
        """Enter a scan taken from `T_map_base` (3,), unless the robot has stood here for long."""
        if not self._has_news(pose):
            return
        cells = place(pose, scan.origins, scan.points, scan.valid, self.resolution)
        beams, box = sound(cells)
        if len(beams) and not self._cover(box[:2], box[2:]):
            beams = beams[:0]
        self.refused += len(cells) - len(beams)
        if len(beams) == 0:
            return
        self._scans += 1
        local = beams.astype(np.int64) - np.concatenate((self.corner, self.corner))
        trace(self.logodds, self._last, self._scans, local)

    def probabilities(self) -> Array:
        """Return (rows, columns) the probability that a cell is occupied, 0.5 where unknown."""
        odds = np.exp(self.logodds.astype(np.float64))
        p: Array = odds / (1.0 + odds)
        return p

    @property
    def origin(self) -> Array:
        """(2,) m, the lower-left corner of cell (0, 0) in map."""
        return np.multiply(self.corner, self.resolution, dtype=np.float64)

    def _has_news(self, pose: Array) -> bool:
        if not math.isfinite(pose[0] + pose[1] + pose[2]):
            return True  # its beams are refused, and counted
        last = self._pose
        moved = (
            last is None
            or math.dist(pose[:2], last[:2]) >= STILL[0]
            or abs(wrap(float(pose[2] - last[2]))) >= STILL[1]
        )
        self._still = 1 if moved else self._still + 1
        if moved:
            self._pose = pose.copy()
        return self._still <= STILL_SCANS

    def _cover(self, low: Array, high: Array) -> bool:
        """Grow to hold the cells from low to high; False if that is absurd."""
        first = self.corner
        end = first + np.array(self.logodds.shape[::-1])
        if first[0] <= low[0] and first[1] <= low[1] and high[0] < end[0] and high[1] < end[1]:
            return True
        low, high = low - MARGIN, high + 1 + MARGIN
        if len(self.logodds):
            low, high = np.minimum(low, first), np.maximum(high, end)
        if np.prod(high - low) > MAX_CELLS:
            return False
        self._resize(low.astype(np.int64), high.astype(np.int64))
        return True

    def _resize(self, low: Ints, high: Ints) -> None:
        columns, rows = high - low
        x, y = self.corner - low if len(self.logodds) else (0, 0)
        height, width = self.logodds.shape
        for name in ("logodds", "_last"):
            old = getattr(self, name)
            new = np.zeros((rows, columns), old.dtype)
            new[y : y + height, x : x + width] = old
            setattr(self, name, new)
        self.corner = low
