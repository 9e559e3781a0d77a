"""Encode snapshots of the map for a page: small, and only what has changed since the last frame.

A frame is a dict of plain values. It always contains the pose and the points of the scan, and else
the new part of the path, the changed landmarks, and the version of the picture of the grid, which
the page then requests. So a frame of a map that hardly changes is as small as its scan.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.observers.live_view import Snapshot
from impslam.types import Array, Landmark

Frame: TypeAlias = dict[str, Any]
Mark: TypeAlias = tuple[Any, ...]
Points: TypeAlias = npt.NDArray[np.float32]

STEP = 0.005  # m; a lidar's noise is twice that, a pixel of the page ten times
MAX_INT16 = 32767  # the largest int16


@dataclass(slots=True)
class SentState:
    """What has been sent to a page: the base of the next difference."""

    version: int = -1
    run: int = -1
    grid: int = -1
    path: Points = field(default_factory=lambda: np.empty((0, 2), np.float32))
    marks: dict[int, Mark] = field(default_factory=dict)


def common(snapshot: Snapshot) -> Frame:
    """Return the part of a frame that is the same for every page."""
    return {
        "seq": snapshot.version,
        "run": snapshot.run,
        "t": _number(snapshot.stamp, 3),
        "scans": snapshot.scans,
        "pose": _pose(snapshot.pose),
        "sigma": ellipse(snapshot.covariance[:2, :2]),
        "turn": _number(math.sqrt(max(float(snapshot.covariance[2, 2]), 0.0)), 5),
        "odometry": _pose(snapshot.odometry),
        "truth": None if snapshot.truth is None else _pose(snapshot.truth),
        "points": packed(snapshot.points, snapshot.pose[:2]),
        "state": snapshot.state,
        "why": snapshot.why,
        "finished": snapshot.finished,
        "placed": snapshot.placed,
    }


def difference(snapshot: Snapshot, marks: dict[int, Mark], sent: SentState) -> Frame:
    """Return the rest of a frame, what has changed for a page, and update `sent`."""
    if snapshot.run != sent.run:
        sent.path, sent.marks, sent.grid = np.empty((0, 2), np.float32), {}, -1
    update: Frame = {"path": _path_update(sent.path, snapshot.path)}
    changed = [mark for key, mark in marks.items() if sent.marks.get(key) != mark]
    gone = [key for key in sent.marks if key not in marks]
    if changed or gone:
        update["marks"] = {"set": changed, "gone": gone}
    grid = snapshot.grid
    if grid is not None and grid.version != sent.grid:
        origin = [_number(value, 4) for value in grid.origin]
        update["grid"] = {"v": grid.version, "o": origin, "r": grid.resolution, "s": grid.size}
        sent.grid = grid.version
    sent.version, sent.run = snapshot.version, snapshot.run
    sent.path, sent.marks = snapshot.path, marks
    return update


def mark(landmark: Landmark) -> Mark:
    """Return id, kind, x, y, 1-sigma ellipse of a point, end points of a wall, sightings."""
    ends = landmark.end_points
    return (
        landmark.id,
        landmark.kind,
        *(_number(value, 3) for value in landmark.position),
        tuple(ellipse(landmark.covariance)) if ends is None else None,
        None if ends is None else tuple(_number(value, 3) for value in ends.ravel()),
        landmark.observations,
    )


def ellipse(covariance: Array) -> list[float | None]:
    """Return half axes (m) and direction of the major one (rad) of a (2, 2) covariance, 1 sigma."""
    if not np.isfinite(covariance).all():
        return [None, None, None]
    values, vectors = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0.0))
    direction = math.atan2(vectors[1, 1], vectors[0, 1])
    return [_number(major, 4), _number(minor, 4), _number(direction, 2)]


def packed(points: Points, origin: Array) -> Frame:
    """Return points (n, 2) relative to an origin as base64 of int16 (x, y pairs) and the step, m."""
    offsets = np.asarray(points, dtype=np.float64) - origin
    offsets = offsets[np.isfinite(offsets).all(axis=1)]
    step = max(STEP, float(np.abs(offsets).max(initial=0.0)) / MAX_INT16)
    return {"step": step, "xy": _base64(np.rint(offsets / step).astype("<i2"))}


def _path_update(old: Points, new: Points) -> Frame:
    """Return the part of a path that differs from the old one; the last point is always sent."""
    same = max(min(len(old), len(new)) - 1, 0)
    start = same if np.array_equal(old[:same], new[:same]) else 0
    return {"from": start, "xy": _base64(new[start:].astype("<f4"))}


def _base64(array: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _pose(pose: Array) -> list[float | None]:
    return [_number(pose[0], 4), _number(pose[1], 4), _number(pose[2], 5)]


def _number(value: float, digits: int) -> float | None:
    """Return a number as JSON can represent it: NaN and infinity become None."""
    return round(float(value), digits) if math.isfinite(value) else None
