"""The last metres of the way as two overlapping maps: the older one is matched against.

Both maps take in the same scans; when the newer one is half a length old, the older one is emptied and
begins anew. So there is always a map of at least half a length behind the robot, and of bounded size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import CELL, SurfaceMap, add, clear, empty_surface_map
from impslam.types import Array, Ints

SURFELS = 60_000
"""In one map at most: at 5 cm they line 3 km of walls."""
AVERAGED = 20.0
"""Points that a surfel is the mean of: enough for a third of the lidar's noise, few enough to follow."""


class Submaps(NamedTuple):
    """Two maps in one frame, in which the robot's pose drifts.

    Attributes
    ----------
    first, second : the maps
    older : (1,) which of them is the older: 0 or 1
    way : (3,) m of way so far, and that at which each of them began; NaN before the first scan
    """

    first: SurfaceMap
    second: SurfaceMap
    older: Ints
    way: Array


def empty_submaps(reach: float) -> Submaps:
    """Return maps for scans that reach so many m."""
    side = 2.0 * reach
    first, second = (empty_surface_map(side, side, SURFELS) for _ in range(2))
    return Submaps(first, second, np.zeros(1, np.int64), np.full(3, np.nan))


@kernel
def oldest(submaps: Submaps) -> SurfaceMap:
    """Return the map that scans are matched against."""
    return submaps.first if submaps.older[0] == 0 else submaps.second


@kernel
def is_empty(submaps: Submaps) -> bool:
    """Tell whether no scan was added yet."""
    return bool(np.isnan(submaps.way[0]))


@kernel
def extend(submaps: Submaps, features: Features, pose: Array, length: float) -> None:
    """Add a scan taken at a pose (3,); a map lasts for `length` m."""
    half = 0.5 * CELL * submaps.first.nearest.shape[0]
    lasted = submaps.way[0] - submaps.way[2 - submaps.older[0]]  # by the newer one
    if is_empty(submaps) or lasted >= length:  # after a blind drive both are out of sight
        clear(submaps.first, pose[:2] - half)
        clear(submaps.second, pose[:2] - half)
        submaps.way[:] = 0.0
    elif lasted >= 0.5 * length:
        clear(oldest(submaps), pose[:2] - half)
        submaps.way[1 + submaps.older[0]] = submaps.way[0]
        submaps.older[0] = 1 - submaps.older[0]
    add(submaps.first, features, pose, AVERAGED)
    add(submaps.second, features, pose, AVERAGED)
