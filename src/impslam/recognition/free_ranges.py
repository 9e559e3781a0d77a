"""Free range from the lidar for each bearing, by the beams of one scan."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array

Floats: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

BEARINGS = 180  # bins of 2 degrees: at least one beam of a common lidar (0.25 to 1 degree) in each
MAX_RANGE = 28.0  # m: a bin is 1 m wide there, and objects between two beams are missed
MAX_LOST, MAX_LOST_ANGLE = 3.5, math.radians(5.0)
"""Beams lost in a row, and the angle between the valid ones beside them, that count like their neighbours.
An absorbing surface and open space look alike, but are seldom so narrow."""
MAX_SPACING = math.radians(10.0)
"""Angle between the beams of a coarse lidar: a wider one hides too much."""


@kernel
def free_ranges(points: Array, laser: Array, spacing: float) -> Floats:
    """Return the nearest range (BEARINGS,) m for each bearing, up to which space is free; 0 if unknown.

    Parameters
    ----------
    points : (n, 2) m, end points of the valid beams, in beam order
    laser : (2,) m, position of the lidar
    spacing : rad, between neighbouring beams of the lidar
    """
    n = len(points)
    few = min((MAX_LOST + 1.0) * spacing, MAX_LOST_ANGLE)
    limit = max(few, min(1.5 * spacing, MAX_SPACING))
    free, empty = np.full(BEARINGS, np.inf, np.float32), np.ones(BEARINGS, np.bool_)
    bearings, ranges = np.empty(n), np.empty(n)
    for i in range(n):
        dx, dy = points[i, 0] - laser[0], points[i, 1] - laser[1]
        bearings[i], ranges[i] = math.atan2(dy, dx), min(math.sqrt(dx * dx + dy * dy), MAX_RANGE)
        b = _bin(bearings[i]) % BEARINGS
        free[b], empty[b] = min(free[b], ranges[i]), False
    for i in range(n):
        j = (i + 1) % n
        turn = wrap_in_kernel(bearings[j] - bearings[i])
        first, last = min(bearings[i], bearings[i] + turn), max(bearings[i], bearings[i] + turn)
        if last - first <= limit:
            for k in range(_bin(first) + 1, _bin(last) + 1):
                if empty[k % BEARINGS]:
                    free[k % BEARINGS] = min(free[k % BEARINGS], ranges[i], ranges[j])
        elif j > 0:  # beams were lost; between the last one and the first one, there are none
            for k in range(_bin(first + spacing), _bin(last - spacing) + 1):
                free[k % BEARINGS] = 0.0
    for b in range(BEARINGS):
        if free[b] == np.inf:
            free[b] = 0.0
    return free


@kernel
def _bin(bearing: float) -> int:
    """Return the number of the bin of a bearing in rad, modulo `BEARINGS`."""
    return math.floor((bearing + math.pi) / (2.0 * math.pi / BEARINGS))
