"""Find markers in a picture, with sub-pixel corners."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from impslam.overhead.edges import refine
from impslam.overhead.setup import Dictionary, dictionary
from impslam.types import Array

SEARCH_MARGIN = 1.5  # of the marker's size, around its last position


class MarkerFinder:
    """Finds the markers of a dictionary, searching around the last position first."""

    def __init__(self, name: Dictionary) -> None:
        kind = dictionary(name)
        self._cells = kind.markerSize + 2
        self._size = len(kind.bytesList)
        how = cv2.aruco.DetectorParameters()
        how.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        how.relativeCornerRefinmentWinSize = 1.0  # of a cell
        how.cornerRefinementMinAccuracy = 0.01  # px
        self._detector = cv2.aruco.ArucoDetector(kind, how)

    @property
    def number(self) -> int:
        """Number of markers in the dictionary."""
        return self._size

    def all(self, picture: Any) -> list[tuple[int, Array]]:
        """Return the numbers and corners (4, 2) px of all markers in a picture."""
        return self._within(_grey(picture), 0, 0)

    def one(self, picture: Any, wanted: int, last: Array | None) -> list[Array]:
        """Return the corners (4, 2) px of every marker with a number; more than one is an error.

        `last` are the corners in the previous picture; the search begins around them.
        """
        grey = _grey(picture)
        found = [] if last is None else self._near(grey, last)
        matching = [corners for number, corners in found if number == wanted]
        if not matching:
            matching = [corners for number, corners in self._within(grey, 0, 0) if number == wanted]
        return matching

    def _near(self, grey: Any, last: Array) -> list[tuple[int, Array]]:
        low, high = last.min(axis=0), last.max(axis=0)
        margin = SEARCH_MARGIN * float((high - low).max())
        x0, y0 = np.maximum(low - margin, 0).astype(int)
        x1, y1 = (high + margin).astype(int) + 1
        return self._within(grey[y0:y1, x0:x1], int(x0), int(y0))

    def _within(self, grey: Any, left: int, top: int) -> list[tuple[int, Array]]:
        corners, numbers, _ = self._detector.detectMarkers(grey)
        if not corners:
            return []
        fine = grey.astype(np.float32)
        found = []
        for number, four in zip(np.ravel(numbers).tolist(), corners, strict=True):
            exact = refine(fine, np.asarray(four.reshape(4, 2), float), self._cells)
            if exact is not None:
                found.append((int(number), exact + np.array([left, top])))
        return found


def middle(corners: Array) -> Array:
    """Return the intersection of the diagonals of a marker's corners (4, 2): its middle in perspective."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    gap = corners[1] - corners[0]
    share = (gap[0] * second[1] - gap[1] * second[0]) / (
        first[0] * second[1] - first[1] * second[0]
    )
    return np.asarray(corners[0] + share * first)


def _grey(picture: Any) -> Any:
    return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
