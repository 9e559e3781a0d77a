"""A path of any length in bounded memory: thinned where it is straight, and evenly with age."""

from __future__ import annotations

import math
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

Points: TypeAlias = npt.NDArray[np.float32]

LIMIT = 4000
"""Points kept: 32 kB, and more than a picture of the map has pixels along a path."""
FINEST = 0.01
"""m: what a path may be off at first; a pixel of a map of 10 m on a screen."""


class ThinPath:
    """Keeps the vertices of a polyline that stays near the path.

    New points enter at a spacing of the tolerance. When the room is full they are simplified (Douglas
    & Peucker 1973); when that frees less than a quarter of it the tolerance doubles. So no point of
    the path is ever farther from the polyline than three times the tolerance: once for its own
    spacing, and twice for a series of tolerances that halve towards the past, each applied once.
    """

    def __init__(self, limit: int = LIMIT) -> None:
        self._points: Points = np.empty((limit, 2), np.float32)
        self._count = self._thinned = 0
        self._newest: Points = np.empty((0, 2), np.float32)
        self.tolerance = FINEST

    def add(self, x: float, y: float) -> None:
        """Go on to a point, m; one that is no number is left out."""
        if not math.isfinite(x + y):
            return
        self._newest = np.array([[x, y]], np.float32)
        last = self._points[self._count - 1]
        if self._count and math.dist((x, y), last) < self.tolerance:
            return
        if self._count == len(self._points):
            self._thin()
        self._points[self._count] = x, y
        self._count += 1

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
        kept = np.concatenate([self._straight(part[: cut + 1])[:-1], self._straight(part[cut:])])
        self._count = begin + len(kept)
        self._points[begin : self._count] = kept

    def _straight(self, part: Points) -> Points:
        if len(part) < 3:
            return part
        kept = cv2.approxPolyDP(part.reshape(-1, 1, 2), self.tolerance, False)
        return kept.reshape(-1, 2).astype(np.float32, copy=False)
