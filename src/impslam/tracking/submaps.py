"""The last metres of the path as two overlapping maps; scans are matched with the older one.

Both maps receive the same scans. When the newer one is half a length old, the older one is cleared and
starts again. So there is always a map of at least half a length behind the robot, and of bounded size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import CELL, SurfaceMap, add, clear, empty_surface_map
from impslam.types import Array, Ints

MAX_SURFELS = 60_000
"""Maximum number in one map: at 5 cm they line 3 km of walls."""
MAX_AVERAGED = 20.0
"""Points that a surfel averages: enough for a third of the lidar's noise, few enough to adapt."""


class Submaps(NamedTuple):
    """Two maps in one frame, in which the robot's pose drifts.

    Attributes
    ----------
    first, second : the maps
    older : (1,) index of the older map, 0 or 1
    travelled : (3,) m so far, and when each map began; NaN before the first scan
    confirmed : (2,) number of surfels of each map without those that only the newest scan shows, if that
        scan fits poorly
    """

    first: SurfaceMap
    second: SurfaceMap
    older: Ints
    travelled: Array
    confirmed: Ints


def empty_submaps(radius: float) -> Submaps:
    """Return maps for scans of a range of `radius` m."""
    side = 2.0 * radius
    first, second = (empty_surface_map(side, side, MAX_SURFELS) for _ in range(2))
    return Submaps(first, second, np.zeros(1, np.int64), np.full(3, np.nan), np.zeros(2, np.int64))


@kernel
def older_map(submaps: Submaps) -> SurfaceMap:
    """Return the map that scans are matched with."""
    return submaps.first if submaps.older[0] == 0 else submaps.second


@kernel
def confirmed_surfels(submaps: Submaps) -> Array:
    """Return the surfels (n, 8) of the older map; see `Submaps.confirmed`.

    In a door, a lidar may pitch and show the floor as a wall.
    """
    older = submaps.older[0]
    return older_map(submaps).surfels[: submaps.confirmed[older]]


@kernel
def is_empty(submaps: Submaps) -> bool:
    """Return whether no scan was added yet."""
    return bool(np.isnan(submaps.travelled[0]))


@kernel
def extend(
    submaps: Submaps, features: Features, pose: Array, length: float, fits: bool = True
) -> None:
    """Add a scan taken at a pose (3,), which may fit poorly; a map lasts for `length` m."""
    half = 0.5 * CELL * submaps.first.cells.shape[0]
    age = submaps.travelled[0] - submaps.travelled[2 - submaps.older[0]]  # of the newer one
    if is_empty(submaps) or age >= length:  # after a long drive without scans both are out of view
        clear(submaps.first, pose[:2] - half)
        clear(submaps.second, pose[:2] - half)
        submaps.travelled[:] = 0.0
    elif age >= 0.5 * length:
        clear(older_map(submaps), pose[:2] - half)
        submaps.travelled[1 + submaps.older[0]] = submaps.travelled[0]
        submaps.older[0] = 1 - submaps.older[0]
    submaps.confirmed[0], submaps.confirmed[1] = submaps.first.size[0], submaps.second.size[0]
    add(submaps.first, features, pose, MAX_AVERAGED)
    add(submaps.second, features, pose, MAX_AVERAGED)
    if fits:
        submaps.confirmed[0], submaps.confirmed[1] = submaps.first.size[0], submaps.second.size[0]
