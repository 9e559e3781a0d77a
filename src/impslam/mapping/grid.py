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
from impslam.geometry.se2 import transform
from impslam.types import Array, Ints, Scan

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
def trace(logodds: Floats, last: Stamps, scan: int, starts: Array, ends: Array) -> None:
    """Enter beams (n, 2) in cell units; `last` (rows, columns) is the scan that last changed a cell.

    Cells are visited by the traversal of Amanatides & Woo 1987, up to but not including the end's.
    """
    n = len(starts)
    for i in range(n):
        column, row = math.floor(ends[i, 0]), math.floor(ends[i, 1])
        if last[row, column] != scan:
            last[row, column] = scan
            logodds[row, column] = min(logodds[row, column] + HIT, CLAMP)
    for i in range(n):
        x, y = starts[i, 0], starts[i, 1]
        dx, dy = ends[i, 0] - x, ends[i, 1] - y
        column, row = math.floor(x), math.floor(y)
        last_column, last_row = math.floor(ends[i, 0]), math.floor(ends[i, 1])
        step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
        per_x = abs(1.0 / dx) if dx != 0.0 else math.inf
        per_y = abs(1.0 / dy) if dy != 0.0 else math.inf
        next_x = (column + (step_x > 0) - x) / dx if dx != 0.0 else math.inf
        next_y = (row + (step_y > 0) - y) / dy if dy != 0.0 else math.inf
        # The number of cells is known beforehand, so rounding cannot make a beam run on.
        for _ in range(abs(last_column - column) + abs(last_row - row)):
            if last[row, column] != scan:
                last[row, column] = scan
                logodds[row, column] = max(logodds[row, column] + MISS, -CLAMP)
            across = next_x < next_y
            if (across and column != last_column) or row == last_row:
                column += step_x
                next_x += per_x
            else:
                row += step_y
                next_y += per_y


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
        starts = transform(pose, scan.origins[scan.valid]) / self.resolution
        ends = transform(pose, scan.points[scan.valid]) / self.resolution
        sound = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
        if not sound.all():
            self.refused += int(np.sum(~sound))
            starts, ends = starts[sound], ends[sound]
        if len(ends) == 0:
            return
        low = np.minimum(starts.min(axis=0), ends.min(axis=0))
        high = np.maximum(starts.max(axis=0), ends.max(axis=0))
        if not self._cover(low, high):
            self.refused += len(ends)
            return
        self._scans += 1
        trace(self.logodds, self._last, self._scans, starts - self.corner, ends - self.corner)

    def probabilities(self) -> Array:
        """Return (rows, columns) the probability that a cell is occupied, 0.5 where unknown."""
        return (1.0 / (1.0 + np.exp(-self.logodds))).astype(np.float64)

    @property
    def origin(self) -> Array:
        """(2,) m, the lower-left corner of cell (0, 0) in map."""
        return self.corner * self.resolution

    def _has_news(self, pose: Array) -> bool:
        if not np.isfinite(pose).all():
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
        """Grow to hold the cells between two corners in cell units; False if that is absurd."""
        first = self.corner
        end = first + np.array(self.logodds.shape[::-1])
        if len(self.logodds) and (low >= first).all() and (high < end - 1).all():
            return True
        low, high = np.floor(low) - MARGIN, np.ceil(high) + MARGIN
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
