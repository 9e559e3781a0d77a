"""The map as it is by now, for a page that looks at it while it grows."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from impslam.geometry.se2 import transform
from impslam.mapping.grid import OccupancyGrid
from impslam.observers.base import Observer, Outcome
from impslam.observers.grid_picture import GridPicture, frozen, paint
from impslam.observers.thin_path import Points, ThinPath
from impslam.trust import Trust
from impslam.types import Array, Landmark, StepResult, TruePose

__all__ = ["GridPicture", "LiveView", "Snapshot"]

LANDMARKS = 0.2
"""s between two readings of the map: what the eye takes for at once."""
SHARE = 0.05
"""Of the estimator's time that reading a large map may take; 20 us a landmark, so that from some
500 landmarks on it is read less often."""
GRID = 1.0
"""s between two pictures of the grid, which changes slowly and is the largest thing to send."""
EXPECTED = 64
"""Scans whose arrival is remembered: 6 s of a lidar at 10 Hz, more than ever wait."""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The state of a map at one moment; nothing in it changes any more.

    Attributes
    ----------
    version : counts up with each change, over all maps of a view; equal versions are equal snapshots
    run : counts the maps of a view: another number is another map
    stamp : s, of the newest scan in it, NaN before the first; later while none comes
    scans : how many scans are in it
    pose, covariance : (3,) and (3, 3), `T_map_base` at `stamp`
    odometry : (3,) dead reckoning from the same start
    path : (n, 2) float32 m in map, thinned, oldest first, its end is the pose at the newest scan; n is
        bounded
    landmarks : the map, walls with their end points; at most 0.2 s older than the pose while there
        are less than 500, and as it is after the last scan of a log
    points : (n, 2) float32 m in map, where the valid beams of the newest scan ended, none when that
        is long ago
    grid : the grid's picture, None before the first; some seconds older than the pose at most
    lost : why the pose should not be trusted, in a few words, "" where all is well
    arrived : host time (`devices.base.now`) at which the newest scan arrived, NaN where nobody told
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
    path: Points
    landmarks: tuple[Landmark, ...]
    points: Points
    grid: GridPicture | None
    lost: str
    arrived: float
    truth: Array | None
    finished: bool


def _empty(version: int, run: int) -> Snapshot:
    nan, points, zero = float("nan"), np.empty((0, 2), np.float32), np.zeros(3)
    return Snapshot(
        version, run, nan, 0, zero, np.zeros((3, 3)), zero, points, (), points, None, "", nan,
        None, False,
    )  # fmt: skip


def _no_landmarks() -> tuple[Landmark, ...]:
    return ()


class LiveView(Observer):
    """Keeps a snapshot of a run for others to look at, at no cost to them and little to the run.

    One thread runs the estimator and calls all but `snapshot`, which any thread may call.
    The grid is painted in a thread of its own.
    """

    def __init__(self) -> None:
        self._shown = _empty(0, 0)
        self._painter: threading.Thread | None = None
        self._picture: tuple[int, GridPicture] | None = None  # of which run
        self._forget(_no_landmarks, OccupancyGrid())

    def _forget(self, landmarks: Callable[[], tuple[Landmark, ...]], grid: OccupancyGrid) -> None:
        self._landmarks, self._grid = landmarks, grid
        self._path, self._trust = ThinPath(), Trust()
        self._expected: deque[tuple[float, float]] = deque(maxlen=EXPECTED)
        self._truth: Array | None = None
        self._stale, self._map_due, self._grid_due = False, 0.0, 0.0

    def begin(self, landmarks: Callable[[], tuple[Landmark, ...]], grid: OccupancyGrid) -> None:
        """Begin a new map: `landmarks` gives it, `grid` is the one that grows along with it."""
        self._forget(landmarks, grid)
        self._shown = _empty(self._shown.version + 1, self._shown.run + 1)

    def expect(self, stamp: float, arrived: float) -> None:
        """Tell when the scan of this stamp arrived on the host, before it is estimated."""
        self._expected.append((stamp, arrived))

    def snapshot(self) -> Snapshot:
        """Return the state by now; it takes no time, and never waits."""
        return self._shown

    def step(self, result: StepResult) -> None:
        """Show a scan's result."""
        before = self._shown
        self._path.add(float(result.pose[0]), float(result.pose[1]))
        self._shown = Snapshot(
            before.version + 1,
            before.run,
            result.stamp,
            before.scans + 1,
            result.pose,
            result.covariance,
            result.odometry,
            self._path.points,
            self._map(result),
            _points_in_map(result),
            self._picture_now(),
            self._trust.step(result),
            self._arrival(result.stamp),
            self._truth,
            finished=False,
        )

    def carry(self, result: StepResult, silent: float) -> None:
        """Show where dead reckoning says that the robot is after so many s without a scan."""
        nothing = np.empty((0, 2), np.float32)
        self._shown = replace(
            self._shown,
            version=self._shown.version + 1,
            stamp=result.stamp,
            pose=result.pose,
            covariance=result.covariance,
            odometry=result.odometry,
            points=nothing,
            lost=f"no usable scan for {max(silent, 1.0):.0f} s; the pose is dead-reckoned",
            arrived=float("nan"),
        )

    def truth(self, pose: TruePose) -> None:
        """Remember the true pose; it shows with the next scan."""
        self._truth = pose.pose

    def refresh(self) -> None:
        """Show landmarks and grid as they are by now, for a run that pauses."""
        self._complete(self._landmarks(), finished=False)

    def finish(self, outcome: Outcome) -> None:
        """Show the map as it is at the end."""
        self._complete(outcome.landmarks, finished=True)

    def _complete(self, landmarks: tuple[Landmark, ...], finished: bool) -> None:
        if self._painter is not None:
            self._painter.join()
        self._paint(frozen(self._grid), self._shown.run)
        shown, grid = self._shown, self._painted()
        version = shown.version + 1
        self._shown = replace(
            shown, version=version, landmarks=landmarks, grid=grid, finished=finished
        )

    def _map(self, result: StepResult) -> tuple[Landmark, ...]:
        """Return the landmarks, read anew if they may have changed and it is time."""
        self._stale |= bool(result.observations or result.new or result.removed)
        begin = time.monotonic()
        if not self._stale or begin < self._map_due:
            return self._shown.landmarks
        landmarks = self._landmarks()
        took = time.monotonic() - begin
        self._stale, self._map_due = False, begin + max(LANDMARKS, took / SHARE)
        return landmarks

    def _picture_now(self) -> GridPicture | None:
        """Return the newest picture of the grid; have the next one made if it is time."""
        run, moment = self._shown.run, time.monotonic()
        idle = self._painter is None or not self._painter.is_alive()
        if idle and moment >= self._grid_due:
            self._grid_due = moment + GRID
            self._painter = threading.Thread(
                target=self._paint, args=(frozen(self._grid), run), name="grid", daemon=True
            )
            self._painter.start()
        return self._painted()

    def _painted(self) -> GridPicture | None:
        """Return the newest picture of this map; the painter may still be at one of the last."""
        made = self._picture
        return made[1] if made is not None and made[0] == self._shown.run else None

    def _paint(self, grid: OccupancyGrid, run: int) -> None:
        before = self._picture
        picture = paint(grid, 1 if before is None else before[1].version + 1)
        if before is None or before[0] != run or not _same(before[1], picture):
            self._picture = run, picture

    def _arrival(self, stamp: float) -> float:
        """Return when the scan of a stamp arrived; those before it have been refused."""
        while self._expected:
            expected, arrived = self._expected.popleft()
            if expected == stamp:
                return arrived
        return float("nan")


def _points_in_map(result: StepResult) -> Points:
    scan = result.scan
    if scan is None:
        return np.empty((0, 2), np.float32)
    return transform(result.scan_pose, scan.points[scan.valid]).astype(np.float32)


def _same(a: GridPicture, b: GridPicture) -> bool:
    return a.png == b.png and bool((a.origin == b.origin).all())
