"""The map as it is by now, for a page that looks at it while it grows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.mapping.grid import OccupancyGrid
from impslam.observers.base import Observer
from impslam.types import Array, Landmark, StepResult, TruePose

Points: TypeAlias = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class GridPicture:
    """The occupancy grid as a PNG with row 0 at the top; what nobody has seen is transparent.

    Attributes
    ----------
    png : the file's bytes
    version : counts up with each new picture, over all maps of a view
    origin : (2,) m in map, the lower-left corner of the picture
    resolution : m, side of a pixel
    size : columns and rows
    """

    png: bytes
    version: int
    origin: Array
    resolution: float
    size: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The state of a map at one moment; nothing in it changes any more.

    Attributes
    ----------
    version : counts up with each change, over all maps of a view; equal versions are equal snapshots
    run : counts the maps of a view: another number is another map
    stamp : s, of the newest scan in it, NaN before the first
    scans : how many scans are in it
    pose, covariance : (3,) and (3, 3), `T_map_base` at `stamp`
    odometry : (3,) dead reckoning from the same start
    path : (n, 2) m in map, thinned, oldest first, its end is the pose; n is bounded
    landmarks : the map, walls with their end points; at most 0.2 s older than the pose
    points : (n, 2) float32 m in map, where the valid beams of the newest scan ended
    grid : the grid's picture, None before the first; at most some seconds older than the pose
    lost : why the pose should not be trusted, in a few words, "" where all is well
    arrived : host time (`devices.base.now`) at which the newest scan arrived, NaN before the first
    truth : (3,) the newest true pose where a log or a simulator tells it, else None
    finished : the run is over
    """

    version: int
    run: int
    stamp: float
    scans: int
    pose: Array
    covariance: Array
    odometry: Array
    path: Array
    landmarks: tuple[Landmark, ...]
    points: Points
    grid: GridPicture | None
    lost: str
    arrived: float
    truth: Array | None
    finished: bool


class LiveView(Observer):
    """Keeps a snapshot of a run for others to look at, at no cost to them and little to the run.

    One thread runs the estimator and calls `begin`, `expect`, `step`, `truth` and `finish`; any
    thread may call `snapshot`.
    """

    def begin(self, landmarks: Callable[[], tuple[Landmark, ...]], grid: OccupancyGrid) -> None:
        """Begin a new map: `landmarks` gives it, `grid` is the one that grows along with it."""
        raise NotImplementedError

    def expect(self, stamp: float, arrived: float) -> None:
        """Tell when the scan of this stamp arrived on the host, before it is estimated."""
        raise NotImplementedError

    def snapshot(self) -> Snapshot:
        """Return the state by now; it takes no time, and never waits."""
        raise NotImplementedError

    def step(self, result: StepResult) -> None:
        """Show a scan's result."""
        raise NotImplementedError

    def truth(self, pose: TruePose) -> None:
        """Show the true pose."""
        raise NotImplementedError
