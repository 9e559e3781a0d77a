"""A path of any length in bounded memory: thinned where it is straight, and evenly with age."""

from __future__ import annotations

import math
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from impslam.types import Array, Ints

Points: TypeAlias = npt.NDArray[np.float32]

LIMIT = 4000
"""Points kept: 32 kB, and more than a picture of the map has pixels along a path."""
FINEST = 0.01
"""m: what a path may be off at first; a pixel of a map of 10 m on a screen."""
FIXED = -1, 0.0, 0.0
"""Of a point that does not move with any keyframe."""


class ThinPath:
    """Keeps the vertices of a polyline that stays near the path.

    New points enter at a spacing of the tolerance. When the room is full they are simplified (Douglas
    & Peucker 1973); when that frees less than a quarter of it the tolerance doubles. So no point of
    the path is ever farther from the polyline than three times the tolerance: once for its own
    spacing, and twice for a series of tolerances that halve towards the past, each applied once.

    Each point hangs on a keyframe, and is moved with it.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._points: Points = np.empty((limit, 2), np.float32)
        self._keyframes, self._offsets = np.empty(limit, np.int64), np.empty((limit, 2))
        self._count = self._thinned = 0
        self._newest: Points = np.empty((0, 2), np.float32)
        self._hung = FIXED
        self.tolerance = FINEST

    def add(self, x: float, y: float, hung: tuple[int, float, float] = FIXED) -> None:
        """Go on to a point, m; one that is no number is left out.

        `hung` are the id of a keyframe, and the point's coordinates in its frame, m.
        """
        if not math.isfinite(x + y):
            return
        self._newest, self._hung = np.array([[x, y]], np.float32), hung
        last = self._points[self._count - 1]
        if self._count and math.dist((x, y), last) < self.tolerance:
            return
        if self._count == len(self._points):
            self._thin()
        self._points[self._count] = x, y
        self._keyframes[self._count], *self._offsets[self._count] = hung
        self._count += 1

    def move(self, poses: Array) -> None:
        """Move the points to where the keyframes (k, 3) are now."""
        n = self._count
        self._points[:n] = _hung(poses, self._keyframes[:n], self._offsets[:n], self._points[:n])
        keyframe, offset = np.array(self._hung[:1]), np.array([self._hung[1:]])
        if len(self._newest):
            self._newest = _hung(poses, keyframe, offset, self._newest)

    @property
    def points(self) -> Points:
        """(n, 2) m, oldest first; the newest point is the last."""
        return np.concatenate([self._points[: self._count], self._newest])

    def _thin(self) -> None:
        self._simplify(self._thinned)
        while self._count > 3 * len(self._points) // 4:
            self.tolerance *= 2.0
            self._simplify(0)
        self._thinned = self._count - 1  # the next part begins where this one ends

    def _simplify(self, begin: int) -> None:
        part = self._points[begin : self._count]
        # Cut at the vertex farthest from the first: cv2 takes ends that meet for a closed curve,
        # and may begin it elsewhere.
        distance = np.hypot(*(part - part[0]).T)
        cut = int(np.flatnonzero(distance == distance.max())[-1])
        rows = np.concatenate(
            [self._straight(part[: cut + 1])[:-1], cut + self._straight(part[cut:])]
        )
        self._count = begin + len(rows)
        for column in (self._points, self._keyframes, self._offsets):
            column[begin : self._count] = column[begin + rows]

    def _straight(self, part: Points) -> Ints:
        """Return which vertices remain."""
        if len(part) < 3:
            return np.arange(len(part))
        kept = cv2.approxPolyDP(part.reshape(-1, 1, 2), self.tolerance, False)
        return _found(kept.reshape(-1, 2).astype(np.float32, copy=False), part)


def _hung(poses: Array, keyframes: Ints, offsets: Array, points: Points) -> Points:
    """Return points (n, 2) where their keyframes have them; those without one stay."""
    x, y, theta = poses[np.maximum(keyframes, 0)].T
    c, s = np.cos(theta), np.sin(theta)
    moved = np.column_stack(
        [x + c * offsets[:, 0] - s * offsets[:, 1], y + s * offsets[:, 0] + c * offsets[:, 1]]
    )
    return np.where((keyframes >= 0)[:, None], moved, points).astype(np.float32)


def _found(kept: Points, part: Points) -> Ints:
    """Return the rows of points that were kept in their order, which cv2 does not tell."""
    places = iter(enumerate(map(tuple, part.tolist())))
    return np.array(
        [
            next(row for row, place in places if place == point)
            for point in map(tuple, kept.tolist())
        ]
    )
