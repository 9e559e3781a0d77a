"""Snapshots of the current map for a live page."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from impslam.geometry.se2 import compose, inverse, transform
from impslam.health import DEGRADED, LOST, NONE, STATES, TRACKING, state_of
from impslam.map import Keyframe, Keyframes, Map, PathRows, Revision, Track
from impslam.map_builder import valid_points
from impslam.maps.grid import OccupancyGrid
from impslam.observers.base import Observer, Outcome
from impslam.observers.grid_picture import GridPicture, paint
from impslam.observers.thin_path import Points, ThinPath
from impslam.observers.true_pose import TruthInMap
from impslam.types import Array, Landmark, Scan, TruePose

LANDMARK_INTERVAL = 0.2
"""Minimum time between updates of the landmarks, s; viewers do not notice this delay."""
MAX_READ_SHARE = 0.05
"""Maximum share of the estimator's time for reading a large map: at 20 us a landmark, maps of more than
about 500 landmarks are read less often. Slower estimators give a draft to read in a thread."""
MAX_BACKGROUND_SHARE = 0.1
"""Maximum share of a processor for the background thread: after a loop closes in a building, all landmarks
are estimated again, and the whole grid is drawn again."""
GRID_INTERVAL = 1.0
"""Minimum time between pictures of the grid, s; it changes slowly and is the largest item to send."""
NO_POINTS = np.empty((0, 2), np.float32)
MAX_EXPECTED = 64
"""Number of scans whose arrival time is kept: 6 s of a lidar at 10 Hz, more than ever wait."""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """An immutable copy of the state of a map.

    Attributes
    ----------
    version : increases with each change, over all maps of a view; equal versions are equal snapshots
    run : number of the map in this view; it changes with each new map
    stamp : that of the newest scan, s; NaN before the first scan; it advances while no scan arrives
    scans : number of scans used
    pose, covariance : (3,) and (3, 3), `T_map_base` at `stamp`
    odometry : (3,) dead reckoning from the same start
    path : (n, 2) float32 m in map, thinned, oldest first, ends at the pose of the newest scan; n is
        bounded; the whole path moves when a loop closes
    landmarks : the landmarks, walls with their end points; some tenths of a second older than the
        pose, seconds in a building, and up to date after the last scan of a log
    points : (n, 2) float32 m in map, end points of the valid beams of the newest scan, empty if it
        is old
    grid : picture of the occupancy grid, None before the first; at most some seconds older than the pose
    state : TRACKING, DEGRADED or LOST
    why : why the pose cannot be trusted, "" if it can
    arrived : host time (`devices.base.now`) at which the newest scan arrived, NaN if unknown
    truth : (3,) the newest true pose in map from a log or a simulator, else None; see `TruthInMap`
    finished : whether the run is over
    placed : whether the robot's place in the map is known; if not, the pose is in a separate frame,
        and path and points are empty
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
    state: str
    why: str
    arrived: float
    truth: Array | None
    finished: bool
    placed: bool = True


def _empty(version: int, run: int) -> Snapshot:
    nan, points, zero = float("nan"), np.empty((0, 2), np.float32), np.zeros(3)
    return Snapshot(
        version, run, nan, 0, zero, np.zeros((3, 3)), zero, points, (), points, None,
        STATES[TRACKING], "", nan, None, False,
    )  # fmt: skip


class LiveRun(Protocol):
    """A run in progress."""

    def map(self) -> Map:
        """Return the current map."""

    def draft_landmarks(self) -> Callable[[], tuple[Landmark, ...]]:
        """Return a function that returns the current landmarks and may be called in another thread."""

    def keyframes(self) -> Keyframes:
        """Return the current keyframes; faster than `map`."""

    def newest_health(self) -> tuple[int, str]:
        """Return the reason of the newest scan's health, as a code and in words."""


class LiveView(Observer):
    """Keeps a snapshot of a run that any thread can read.

    One thread runs the estimator and calls all methods except `snapshot`, which any thread may call.
    A background thread draws the grid and reads the landmarks.
    """

    def __init__(self) -> None:
        self._snapshot = _empty(0, 0)
        self._worker: threading.Thread | None = None
        self._picture: tuple[int, GridPicture] | None = None  # with the number of its run
        self._landmarks: tuple[int, tuple[Landmark, ...]] = 0, ()
        self._reset(None, 0.05)

    def _reset(self, run: LiveRun | None, resolution: float) -> None:
        self._run, self._grid = run, OccupancyGrid(resolution)
        self._path = ThinPath()
        self._expected: deque[tuple[float, float]] = deque(maxlen=MAX_EXPECTED)
        self._truth = TruthInMap()
        self._placed = True
        self._stale, self._landmarks_due, self._grid_due = False, 0.0, 0.0

    def begin(self, run: LiveRun, resolution: float = 0.05, *, placed: bool = True) -> None:
        """Start to show the map of a run.

        `resolution` is the cell size of the grid, m. `placed` is False if the run continues a map and
        the robot's place in it is not known yet.
        """
        self._reset(run, resolution)
        self._placed = placed
        empty = _empty(self._snapshot.version + 1, self._snapshot.run + 1)
        self._snapshot = replace(empty, placed=placed)

    def expect(self, stamp: float, arrived: float) -> None:
        """Record the host time at which the scan with this stamp arrived; call it before the estimate."""
        self._expected.append((stamp, arrived))

    def snapshot(self) -> Snapshot:
        """Return the current state without waiting."""
        return self._snapshot

    def follow(self, track: Track, path: PathRows) -> None:
        """Show the newest sweep of a track."""
        row = track.rows.stop - 1
        points = _points(track.sweeps.scan(row), track.sweeps.T_middle_stamp[row])
        self._extend_path(path, track.anchor, track.T_anchor_base)
        self._show(path, points)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Show a keyframe and its revision."""
        self._stale = True
        self._placed = revision.is_placed
        points = _points(keyframe.scan, keyframe.T_keyframe_stamp)
        if len(revision.ids) > 1 and self._run is not None:
            self._path.move(self._run.keyframes().poses)
        self._extend_path(path, keyframe.id, keyframe.T_keyframe_stamp[None])
        self._show(path, points)

    def _extend_path(self, path: PathRows, keyframe: int, T_keyframe_base: Array) -> None:
        """Add poses to the path, attached to a keyframe."""
        for (x, y, _), (dx, dy, _) in zip(
            path.poses.tolist(), T_keyframe_base.tolist(), strict=True
        ):
            self._path.add(x, y, (keyframe, dx, dy))

    def _show(self, path: PathRows, points: Points) -> None:
        before, stamp = self._snapshot, float(path.stamps[-1])
        self._start_update()
        if self._placed:
            self._truth.align(stamp, path.poses[-1])
        self._snapshot = Snapshot(
            before.version + 1,
            before.run,
            stamp,
            before.scans + len(path.stamps),
            path.poses[-1],
            path.covariances[-1],
            path.odometry[-1],
            self._path.points if self._placed else NO_POINTS,
            self._current_landmarks(),
            _moved(path.poses[-1], points) if self._placed else NO_POINTS,
            self._current_picture(),
            *self._state(),
            self._arrival(stamp),
            self._truth.pose,
            finished=False,
            placed=self._placed,
        )

    def _state(self) -> tuple[str, str]:
        """Return the state of the newest scan and the reason."""
        reason, why = (NONE, "") if self._run is None else self._run.newest_health()
        return STATES[state_of(reason)], why

    def show_dead_reckoned(self, path: PathRows, silent: float) -> None:
        """Show the dead-reckoned pose after `silent` seconds without a scan."""
        self._snapshot = replace(
            self._snapshot,
            version=self._snapshot.version + 1,
            stamp=float(path.stamps[-1]),
            pose=path.poses[-1],
            covariance=path.covariances[-1],
            odometry=path.odometry[-1],
            truth=self._truth.pose,
            points=NO_POINTS,
            state=STATES[DEGRADED],
            why=f"lidar silent for {max(silent, 1.0):.0f} s; the pose is dead-reckoned",
            arrived=float("nan"),
        )

    def end(self, why: str) -> None:
        """Show that the run is over, and that the robot is not followed any more."""
        self._snapshot = replace(
            self._snapshot,
            version=self._snapshot.version + 1,
            points=NO_POINTS,
            state=STATES[LOST],
            why=why,
            arrived=float("nan"),
            finished=True,
        )

    def truth(self, pose: TruePose) -> None:
        """Keep the true pose, to be shown with the next scan."""
        self._truth.add(pose)

    def refresh(self) -> None:
        """Show the current landmarks and grid, for a paused run."""
        if self._run is not None:
            self._complete(self._run.map(), finished=False)

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Show the final map."""
        del outcome
        self._complete(known, finished=True)

    def _complete(self, known: Map, finished: bool) -> None:
        if self._worker is not None:
            self._worker.join()
        self._paint(known.keyframes, self._grid, self._snapshot.run)
        self._landmarks = self._snapshot.run, known.landmarks
        shown = replace(self._snapshot, version=self._snapshot.version + 1, finished=finished)
        shown = replace(shown, landmarks=known.landmarks, grid=self._current_picture())
        self._snapshot = self._refined(shown, known) if finished else shown

    def _refined(self, shown: Snapshot, known: Map) -> Snapshot:
        """Return a snapshot with the path and the pose of the refined map."""
        if not known.placed()[-1:].any():
            return shown
        self._path.move(known.keyframes.poses)
        rows = known.rows()
        pose, covariance = rows.poses[-1], rows.covariances[-1]
        points = _moved(compose(pose, inverse(shown.pose)), shown.points)
        path = self._path.points
        path[-1] = pose[:2]
        return replace(shown, pose=pose, covariance=covariance, points=points, path=path)

    def _start_update(self) -> None:
        """Start to update the landmarks and the grid in the background, if they are due."""
        if self._run is None or (self._worker is not None and self._worker.is_alive()):
            return
        begin, read, keyframes = time.monotonic(), None, None
        if self._stale and begin >= self._landmarks_due:
            read = self._run.draft_landmarks()
            took = time.monotonic() - begin
            self._stale = False
            self._landmarks_due = begin + max(LANDMARK_INTERVAL, took / MAX_READ_SHARE)
        if begin >= self._grid_due:
            self._grid_due, keyframes = begin + GRID_INTERVAL, self._run.keyframes()
        if read is not None or keyframes is not None:
            job = read, keyframes, self._grid, self._snapshot.run
            self._worker = threading.Thread(
                target=self._update, args=job, name="live view", daemon=True
            )
            self._worker.start()

    def _update(
        self,
        read: Callable[[], tuple[Landmark, ...]] | None,
        keyframes: Keyframes | None,
        grid: OccupancyGrid,
        run: int,
    ) -> None:
        """Read the landmarks and draw the grid; a long update is followed by a long pause."""
        begin = time.monotonic()
        try:
            if read is not None:
                self._landmarks = run, read()
            if keyframes is not None:
                self._paint(keyframes, grid, run)
        finally:
            end = time.monotonic()
            due = end + (end - begin) / MAX_BACKGROUND_SHARE
            if run == self._snapshot.run:
                self._landmarks_due = max(self._landmarks_due, due)
                self._grid_due = max(self._grid_due, due)

    def _current_landmarks(self) -> tuple[Landmark, ...]:
        """Return the newest landmarks of this map."""
        run, landmarks = self._landmarks
        return landmarks if run == self._snapshot.run else ()

    def _current_picture(self) -> GridPicture | None:
        """Return the newest picture of this map; the thread may still be drawing the previous map."""
        newest = self._picture
        return newest[1] if newest is not None and newest[0] == self._snapshot.run else None

    def _paint(self, keyframes: Keyframes, grid: OccupancyGrid, run: int) -> None:
        keyframes.draw(grid)
        before = self._picture
        picture = paint(grid, 1 if before is None else before[1].version + 1)
        if before is None or before[0] != run or not _same(before[1], picture):
            self._picture = run, picture

    def _arrival(self, stamp: float) -> float:
        """Return when the scan with a stamp arrived; earlier expected scans were dropped."""
        while self._expected:
            expected, arrived = self._expected.popleft()
            if expected == stamp:
                return arrived
        return float("nan")


def _points(scan: Scan | None, T_middle_stamp: Array) -> Points:
    """Return the end points of the valid beams in base_link at the scan's stamp."""
    if scan is None:
        return np.empty((0, 2), np.float32)
    return _moved(inverse(T_middle_stamp), valid_points(scan))


def _moved(T: Array, points: Points) -> Points:
    return transform(T, points.astype(np.float64)).astype(np.float32)


def _same(a: GridPicture, b: GridPicture) -> bool:
    return a.png == b.png and bool((a.origin == b.origin).all())
