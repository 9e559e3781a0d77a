"""A path of any length in bounded memory: straight parts are thinned, and older parts more so."""

from __future__ import annotations

import math
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from impslam.geometry.se2 import transform
from impslam.types import Array, Ints

Points: TypeAlias = npt.NDArray[np.float32]

MAX_POINTS = 4000
"""Number of points kept: 32 kB, and more than a path has pixels on a picture of the map."""
MIN_TOLERANCE = 0.01
"""Initial tolerance of the path, m: a pixel of a map of 10 m on a screen."""
FIXED = -1, 0.0, 0.0
"""Attachment of a point that moves with no keyframe."""


class ThinPath:
    """Keeps the vertices of a polyline that approximates the path.

    New points enter at a spacing of the tolerance. When `limit` points are stored, the new ones are
    simplified (Douglas & Peucker 1973); if that frees less than a quarter, the tolerance doubles. So no
    point of the path is farther from the polyline than three times the tolerance: once for its own
    spacing, and twice for a series of tolerances that halve towards the past, each applied once.

    Each point is attached to a keyframe and moves with it.
    """

    def __init__(self, limit: int = MAX_POINTS) -> None:
        self._points: Points = np.empty((limit, 2), np.float32)
        self._keyframes, self._offsets = np.empty(limit, np.int64), np.empty((limit, 2))
        self._count = self._thinned = 0
        self._newest: Points = np.empty((0, 2), np.float32)
        self._attachment = FIXED
        self.tolerance = MIN_TOLERANCE

    def add(self, x: float, y: float, attachment: tuple[int, float, float] = FIXED) -> None:
        """Append a point, m, unless it is not finite.

        `attachment` is the id of a keyframe and the point's coordinates in its frame, m.
        """
        if not math.isfinite(x + y):
            return
        self._newest, self._attachment = np.array([[x, y]], np.float32), attachment
        last = self._points[self._count - 1]
        if self._count and math.dist((x, y), last) < self.tolerance:
            return
        if self._count == len(self._points):
            self._thin()
        self._points[self._count] = x, y
        self._keyframes[self._count], *self._offsets[self._count] = attachment
        self._count += 1

    def move(self, poses: Array) -> None:
        """Move the points with the keyframes, given the current poses (k, 3)."""
        n = self._count
        self._points[:n] = _moved(poses, self._keyframes[:n], self._offsets[:n], self._points[:n])
        keyframe, offset = np.array(self._attachment[:1]), np.array([self._attachment[1:]])
        if len(self._newest):
            self._newest = _moved(poses, keyframe, offset, self._newest)

    @property
    def points(self) -> Points:
        """(n, 2) m, oldest first, including the newest point."""
        return np.concatenate([self._points[: self._count], self._newest])

    def _thin(self) -> None:
        self._simplify(self._thinned)
        while self._count > 3 * len(self._points) // 4:
            self.tolerance *= 2.0
            self._simplify(0)
        self._thinned = self._count - 1  # the next part begins at the end of this one

    def _simplify(self, begin: int) -> None:
        part = self._points[begin : self._count]
        # Cut at the vertex farthest from the first: cv2 treats ends that meet as a closed curve,
        # and may start it elsewhere.
        distance = np.hypot(*(part - part[0]).T)
        cut = int(np.flatnonzero(distance == distance.max())[-1])
        rows = np.concatenate(
            [self._kept_rows(part[: cut + 1])[:-1], cut + self._kept_rows(part[cut:])]
        )
        self._count = begin + len(rows)
        for column in (self._points, self._keyframes, self._offsets):
            column[begin : self._count] = column[begin + rows]

    def _kept_rows(self, part: Points) -> Ints:
        """Return the rows of the vertices that remain."""
        if len(part) < 3:
            return np.arange(len(part))
        kept = cv2.approxPolyDP(part.reshape(-1, 1, 2), self.tolerance, False)
        return _rows_of(kept.reshape(-1, 2).astype(np.float32, copy=False), part)


def _moved(poses: Array, keyframes: Ints, offsets: Array, points: Points) -> Points:
    """Return points (n, 2) moved with their keyframes; those without one stay."""
    moved = transform(poses[np.maximum(keyframes, 0)], offsets[:, None])[:, 0]
    return np.where((keyframes >= 0)[:, None], moved, points).astype(np.float32)


def _rows_of(kept: Points, part: Points) -> Ints:
    """Return the rows of the kept points in `part`, in order, which cv2 does not return."""
    rows = iter(enumerate(map(tuple, part.tolist())))
    return np.array(
        [
            next(row for row, candidate in rows if candidate == point)
            for point in map(tuple, kept.tolist())
        ]
    )
