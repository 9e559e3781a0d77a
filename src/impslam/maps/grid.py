"""Occupancy grid with free, occupied and unknown cells.

Each cell holds the log-odds of being occupied (Moravec & Elfes 1985; Thrun et al. 2005, Eq. 9.7). A scan
changes a cell at most once, and the end of a beam takes precedence over passing beams: otherwise the many
beams that graze a wall would erase it.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.errors import ConfigError
from impslam.geometry.angles import wrap, wrap_in_kernel
from impslam.geometry.kernels import kernel, read_only
from impslam.types import Array, Ints

STATIONARY = (0.01, math.radians(0.2))
"""m and rad: with less motion since the last drawn scan, the robot is stationary."""
STATIONARY_SCANS = 5
"""Scans drawn while stationary; further ones have the same errors and add no information."""
MARGIN = 64
"""Unknown cells kept around the known area, so that the grid seldom grows."""
MAX_CELLS = 40_000_000
"""Beyond 100 000 m^2 at 5 cm (320 MB) a pose has diverged; its scan is rejected."""
MIN_RESOLUTION, MAX_RESOLUTION = 0.001, 10.0
"""m, limits of a cell's side."""
SKIP, DRAW, REJECT = 0, 1, 2
"""Decisions on a scan."""

Floats: TypeAlias = npt.NDArray[np.float32]
Points: TypeAlias = npt.NDArray[np.float32]
Stamps: TypeAlias = npt.NDArray[np.int32]


class BeamModel(NamedTuple):
    """How a scan changes the log-odds of a cell.

    Attributes
    ----------
    hit, miss : change of a cell in which a beam ends, and of one through which beams pass
    limit : log-odds beyond which the cell does not change, so that the map can follow a changed world
        (Hornung et al. 2013, 4.1)
    """

    hit: float
    miss: float
    limit: float


DRAWN = BeamModel(2.0 * math.log(0.67 / 0.33), math.log(0.33 / 0.67), math.log(0.99 / 0.01))
"""For maps that are displayed and used for planning: a cell is occupied if more than a third of the scans
that reach it end in it. A wall on the border of two cells ends half of its beams in either one, fewer with
noise; GMapping uses a quarter, which also keeps more single beams from the edges of objects. Two passes
make a cell free in a trinary map (p < 0.196), six clear any cell; `map_image` makes an exception for a
robot that stands."""
BALANCED = BeamModel(math.log(0.7 / 0.3), math.log(0.3 / 0.7), math.log(0.97 / 0.03))
"""For questions of evidence: log-odds count by how many more scans hit a cell than passed through it.
With 2 cm of range noise a beam ends in its own cell of 5 cm in 7 of 10."""


class PlacedScans(NamedTuple):
    """The scans of k keyframes and their poses.

    Attributes
    ----------
    poses : (k, 3) `T_map_base`
    origins : (k, 2) m, position of the laser in base_link
    starts : (k + 1,) end points of scan i are `points[starts[i] : starts[i + 1]]`
    points : (p, 2) m in base_link
    """

    poses: Array
    origins: Array
    starts: Ints
    points: Points


@kernel
def is_at(place: Array, pose: Array) -> bool:
    """Return whether a robot at a pose (3,) has not moved from a place (3,); never if one is NaN."""
    apart = math.hypot(pose[0] - place[0], pose[1] - place[1])
    return bool(apart < STATIONARY[0] and abs(wrap_in_kernel(pose[2] - place[2])) < STATIONARY[1])


class Standstill:
    """Counts keyframes at one place: some estimators add them at rest, which may last for days."""

    def __init__(self) -> None:
        self._place, self._count = np.full(3, np.nan), 0

    def is_redundant(self, pose: Array) -> bool:
        """Add a keyframe at a pose (3,); return whether `STATIONARY_SCANS` before it show the same."""
        if is_at(*read_only(self._place, pose)):
            self._count += 1
        else:
            self._place, self._count = pose, 1
        return self._count > STATIONARY_SCANS


@kernel
def _select(scans: PlacedScans, size: float, box: Array, last: Array) -> Ints:
    """Return the decision on each scan: SKIP, DRAW or REJECT.

    `box` (low x, low y, high x, high y) grows to include the cells of scans to draw. `last` is the pose of
    the last scan after a motion, NaN before the first, and the number of scans there.
    """
    poses, origins, starts, points = scans
    out = np.empty(len(poses), np.int64)
    wider, p = np.empty(4), np.empty(2)
    for k in range(len(poses)):
        x0, y0, theta = poses[k]
        if not math.isfinite(x0 + y0 + theta):
            out[k] = REJECT
            continue
        is_stationary = is_at(last, poses[k])
        last[3] = last[3] + 1.0 if is_stationary else 1.0
        if not is_stationary:
            last[:3] = poses[k]
        if last[3] > STATIONARY_SCANS or starts[k] == starts[k + 1]:
            out[k] = SKIP
            continue
        wider[:] = box
        c, s = math.cos(theta), math.sin(theta)
        for i in range(-1, starts[k + 1] - starts[k]):
            if i < 0:
                p[:] = origins[k]
            else:
                p[0], p[1] = points[starts[k] + i, 0], points[starts[k] + i, 1]
            x, y = (x0 + c * p[0] - s * p[1]) / size, (y0 + s * p[0] + c * p[1]) / size
            wider[0], wider[1] = min(wider[0], x), min(wider[1], y)
            wider[2], wider[3] = max(wider[2], x), max(wider[3], y)
        wide, high = wider[2] - wider[0] + 2.0 * MARGIN, wider[3] - wider[1] + 2.0 * MARGIN
        out[k] = DRAW if wide * high <= MAX_CELLS else REJECT
        if out[k] == DRAW:
            box[:] = wider
    return out


class GridCells(NamedTuple):
    """The cells of a grid; `changed` is the number of the scan that changed each of them last.

    `corner` (2,) is the column and row of cell (0, 0), counted from the origin of map; `size` m is the
    side of a cell.
    """

    logodds: Floats
    changed: Stamps
    corner: Ints
    size: float


@kernel
def _draw(
    cells: GridCells, model: BeamModel, first: int, scans: PlacedScans, verdicts: Ints
) -> int:
    """Draw the selected scans, numbered from `first` on; return the next number."""
    logodds, changed, corner, size = cells
    poses, origins, starts, points = scans
    number = first
    beams = np.empty((np.diff(starts).max(), 4), np.int64)
    for k in range(len(poses)):
        if verdicts[k] != DRAW:
            continue
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x = poses[k, 0] + c * origins[k, 0] - s * origins[k, 1]
        y = poses[k, 1] + s * origins[k, 0] + c * origins[k, 1]
        column, row = math.floor(x / size) - corner[0], math.floor(y / size) - corner[1]
        n = starts[k + 1] - starts[k]
        for i in range(n):
            px, py = np.float64(points[starts[k] + i, 0]), np.float64(points[starts[k] + i, 1])
            beams[i, 0], beams[i, 1] = column, row
            beams[i, 2] = math.floor((poses[k, 0] + c * px - s * py) / size) - corner[0]
            beams[i, 3] = math.floor((poses[k, 1] + s * px + c * py) / size) - corner[1]
        trace(logodds, changed, number, beams[:n], model)
        number += 1
    return number


@kernel
def trace(logodds: Floats, last: Stamps, scan: int, beams: Ints, model: BeamModel) -> None:
    """Draw beams (n, 4), from cell to cell; `last` is the last scan that changed each cell.

    A beam advances by one cell per step along its longer side (Bresenham 1965), in fixed point with 32
    binary digits. This has no unpredictable branch, and is three times as fast as the exact traversal of
    Amanatides & Woo 1987, whose additional cells the next beam covers anyway.
    """
    width, half = logodds.shape[1], np.int64(1) << 31
    cells, changed = logodds.reshape(-1), last.reshape(-1)
    for i in range(len(beams)):
        cell = beams[i, 3] * width + beams[i, 2]
        if changed[cell] != scan:
            changed[cell] = scan
            cells[cell] = min(cells[cell] + model.hit, model.limit)
    for i in range(len(beams)):
        dx, dy = beams[i, 2] - beams[i, 0], beams[i, 3] - beams[i, 1]
        steps = max(abs(dx), abs(dy), 1)
        step_x, step_y = (dx << 32) // steps, (dy << 32) // steps
        x, y = (beams[i, 0] << 32) + half, (beams[i, 1] << 32) + half
        for _ in range(steps):
            # unsigned, which avoids a test for negative indices
            cell = np.uint64((y >> 32) * width + (x >> 32))
            if changed[cell] != scan:
                changed[cell] = scan
                cells[cell] = max(cells[cell] + model.miss, -model.limit)
            x += step_x
            y += step_y


class OccupancyGrid:
    """An occupancy grid that grows with the scans; cell (0, 0) is the lower-left one.

    Attributes
    ----------
    logodds : (rows, columns) float32, 0 for unknown cells
    corner : (2,) column and row of cell (0, 0), counted from the origin of map
    refused : number of beams not drawn because the pose of their scan has diverged or is not finite
    """

    def __init__(self, resolution: float = 0.05, model: BeamModel = DRAWN) -> None:
        if not (
            isinstance(resolution, int | float) and MIN_RESOLUTION <= resolution <= MAX_RESOLUTION
        ):
            raise ConfigError(
                f"resolution = {resolution!r}: a cell's side is {MIN_RESOLUTION:g} to {MAX_RESOLUTION:g} m"
            )
        self.resolution, self._model = float(resolution), model
        self._clear()

    def _clear(self) -> None:
        self.logodds: Floats = np.zeros((0, 0), np.float32)
        self.corner: Ints = np.zeros(2, np.int64)
        self.refused = 0
        self._changed: Stamps = np.zeros((0, 0), np.int32)
        self._number = 1
        self._box = np.array([math.inf, math.inf, -math.inf, -math.inf])
        self._last = np.array([math.nan, math.nan, math.nan, 0.0])
        self._drawn = np.empty((0, 3))

    def draw(self, scans: PlacedScans) -> None:
        """Draw scans; earlier ones are only drawn again if one of them has moved."""
        n = len(self._drawn)
        if not np.array_equal(scans.poses[:n], self._drawn, equal_nan=True):
            self._clear()
            n = 0
        self._drawn = scans.poses
        if n == len(scans.poses):
            return
        new = PlacedScans(
            *read_only(scans.poses[n:], scans.origins[n:], scans.starts[n:], scans.points)
        )
        verdicts = _select(new, self.resolution, self._box, self._last)
        self.refused += int(np.diff(new.starts)[verdicts == REJECT].sum())
        if (verdicts == DRAW).any():
            self._cover(np.floor(self._box[:2]), np.floor(self._box[2:]))
            cells = GridCells(self.logodds, self._changed, self.corner, self.resolution)
            self._number = _draw(cells, self._model, self._number, new, verdicts)

    @property
    def is_stationary(self) -> bool:
        """Whether all scans are from one place, of one lidar or several."""
        poses = self._drawn[np.isfinite(self._drawn).all(axis=1)]
        off = poses - poses[:1]
        moved = np.hypot(off[:, 0], off[:, 1]) >= STATIONARY[0]
        return not (moved | (np.abs(wrap(off[:, 2])) >= STATIONARY[1])).any()

    @property
    def origin(self) -> Array:
        """(2,) m, the lower-left corner of cell (0, 0) in map."""
        return np.multiply(self.corner, self.resolution, dtype=np.float64)

    def _cover(self, low: Array, high: Array) -> None:
        """Grow to include the cells from low to high."""
        first = self.corner
        end = first + np.array(self.logodds.shape[::-1])
        if len(self.logodds) and (first <= low).all() and (high < end).all():
            return
        low, high = low - MARGIN, high + 1 + MARGIN
        if len(self.logodds):
            low, high = np.minimum(low, first), np.maximum(high, end)
        self._resize(low.astype(np.int64), high.astype(np.int64))

    def _resize(self, low: Ints, high: Ints) -> None:
        columns, rows = high - low
        x, y = self.corner - low if len(self.logodds) else (0, 0)
        height, width = self.logodds.shape
        for name in ("logodds", "_changed"):
            old = getattr(self, name)
            new = np.zeros((rows, columns), old.dtype)
            new[y : y + height, x : x + width] = old
            setattr(self, name, new)
        self.corner = low
