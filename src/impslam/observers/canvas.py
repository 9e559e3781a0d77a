"""A picture of a part of the map, drawn with OpenCV, which a run loads anyway; matplotlib takes 0.5 s."""

from __future__ import annotations

from copy import copy
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from impslam.types import Array

Picture: TypeAlias = npt.NDArray[np.uint8]
Colour: TypeAlias = tuple[int, int, int]

FRACTION = 4
"""Bits of a pixel's fraction that OpenCV draws with."""
FARTHEST = 30_000.0
"""Pixels; odometry may run off anywhere, and OpenCV's coordinates are finite."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def colour(code: str) -> Colour:
    """Return "#rrggbb" as OpenCV has it: blue, green, red."""
    red, green, blue = bytes.fromhex(code.removeprefix("#"))
    return blue, green, red


class Canvas:
    """A picture of the rectangle left, right, bottom, top (m, x right, y up) of the map.

    Attributes
    ----------
    pixels : (rows, columns, 3) uint8, blue, green, red; row 0 is at the top
    scale : pixels per m
    corner : (2,) m, the upper left one
    """

    def __init__(self, bounds: tuple[float, float, float, float], size: int, ground: str) -> None:
        left, right, bottom, top = bounds
        self.scale = size / max(right - left, top - bottom)
        self.corner = np.array([left, top])
        columns, rows = (max(1, round(side * self.scale)) for side in (right - left, top - bottom))
        self.pixels: Picture = np.full((rows, columns, 3), colour(ground), np.uint8)

    def copy(self) -> Canvas:
        """Return a canvas with pixels of its own."""
        twin = copy(self)
        twin.pixels = self.pixels.copy()
        return twin

    def place(self, points: Array) -> Array:
        """Return where points (..., 2) m are, in pixels from the centre of the first: x, y."""
        at = (points - self.corner) * (self.scale, -self.scale) - 0.5
        return np.asarray(np.clip(at, -FARTHEST, FARTHEST))

    def paste(self, image: Picture, left: float, top: float, resolution: float) -> None:
        """Lay an image (rows, columns, 3) whose pixels are `resolution` m wide on the map."""
        zoom = resolution * self.scale
        x, y = self.place(np.array([left, top])) + 0.5
        onto = np.array([[zoom, 0.0, x + 0.5 * zoom - 0.5], [0.0, zoom, y + 0.5 * zoom - 0.5]])
        if zoom < 1.0:  # else cells that are thinner than a pixel would vanish
            rows, columns = (max(1, round(side * zoom)) for side in image.shape[:2])
            image = np.asarray(
                cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8
            )
            onto = np.array([[1.0, 0.0, round(x)], [0.0, 1.0, round(y)]])
        size = self.pixels.shape[1::-1]
        look = {"flags": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_TRANSPARENT}
        cv2.warpAffine(image, onto, size, dst=self.pixels, **look)

    def line(self, points: Array, code: str, width: float, closed: bool = False) -> None:
        """Draw a polyline through points (n, 2) m, `width` pixels wide."""
        cv2.polylines(
            *(self.pixels, [self._exact(points)], closed, colour(code), max(1, round(width))),
            *(cv2.LINE_AA, FRACTION),
        )

    def dashes(self, points: Array, code: str, width: float, dash: float, gap: float) -> None:
        """Draw a polyline of dashes and gaps, in pixels."""
        steps = np.hypot(*np.diff(points, axis=0).T) * self.scale
        way = np.concatenate([[0.0], np.cumsum(steps)])
        for begin in np.arange(0.0, way[-1], dash + gap):
            end = min(begin + dash, way[-1])
            stops = np.unique([begin, *way[(way > begin) & (way < end)], end])
            self.line(np.column_stack([np.interp(stops, way, c) for c in points.T]), code, width)

    def fill(self, outline: Array, code: str) -> None:
        """Fill a convex outline (n, 2) m."""
        cv2.fillConvexPoly(self.pixels, self._exact(outline), colour(code), cv2.LINE_AA, FRACTION)

    def fade(self, before: Picture, opacity: float) -> None:
        """Make what was drawn since `before`, a copy of the pixels, so opaque."""
        cv2.addWeighted(self.pixels, opacity, before, 1.0 - opacity, 0.0, dst=self.pixels)

    def label(self, at: Array, words: str, code: str, size: float, ground: str = "") -> None:
        """Write words (ASCII: the font has no more), their lower left corner at a point (2,) m."""
        (x, y), (width, height) = np.round(self.place(at)).astype(int), text_size(words, size)
        if ground:
            corners = (int(x) - 3, int(y) - height - 4), (int(x) + width + 3, int(y) + 4)
            cv2.rectangle(self.pixels, *corners, colour(ground), cv2.FILLED)
        look = FONT, size, colour(code), 1, cv2.LINE_AA
        cv2.putText(self.pixels, words, (int(x), int(y)), *look)

    def _exact(self, points: Array) -> npt.NDArray[np.int32]:
        return np.round(self.place(points) * (1 << FRACTION)).astype(np.int32)


def text_size(words: str, size: float) -> tuple[int, int]:
    """Return width and height of words, in pixels."""
    (width, height), _ = cv2.getTextSize(words, FONT, size, 1)
    return int(width), int(height)


def png(picture: Picture) -> bytes:
    """Return a picture as a PNG file."""
    done, data = cv2.imencode(".png", picture)
    assert done, "a PNG of any size can be encoded"
    return data.tobytes()
