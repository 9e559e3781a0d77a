"""A picture of a part of the map, drawn with OpenCV, which is loaded anyway; matplotlib would add 0.5 s."""

from __future__ import annotations

from copy import copy
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from impslam.types import Array

Picture: TypeAlias = npt.NDArray[np.uint8]
Colour: TypeAlias = tuple[int, int, int]

FRACTION_BITS = 4
"""Fractional bits of the pixel coordinates passed to OpenCV."""
MAX_COORDINATE = 30_000.0
"""Limit of pixel coordinates: odometry may drift anywhere, and OpenCV's coordinates are bounded."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def colour(code: str) -> Colour:
    """Return "#rrggbb" in OpenCV's order: blue, green, red."""
    red, green, blue = bytes.fromhex(code.removeprefix("#"))
    return blue, green, red


class Canvas:
    """A picture of a rectangle of the map: left, right, bottom, top in m, with x right and y up.

    Attributes
    ----------
    pixels : (rows, columns, 3) uint8, blue, green, red; row 0 is at the top
    scale : pixels per m
    corner : (2,) upper left corner, m
    """

    def __init__(self, bounds: tuple[float, float, float, float], size: int, ground: str) -> None:
        left, right, bottom, top = bounds
        self.scale = size / max(right - left, top - bottom)
        self.corner = np.array([left, top])
        columns, rows = (max(1, round(side * self.scale)) for side in (right - left, top - bottom))
        self.pixels: Picture = np.full((rows, columns, 3), colour(ground), np.uint8)

    def copy(self) -> Canvas:
        """Return a copy with its own pixels."""
        copied = copy(self)
        copied.pixels = self.pixels.copy()
        return copied

    def to_pixels(self, points: Array) -> Array:
        """Return pixel coordinates x, y of points (..., 2) m; (0, 0) is the centre of the first pixel."""
        pixels = (points - self.corner) * (self.scale, -self.scale) - 0.5
        return np.asarray(np.clip(pixels, -MAX_COORDINATE, MAX_COORDINATE))

    def paste(self, image: Picture, left: float, top: float, resolution: float) -> None:
        """Draw an image (rows, columns, 3) with `resolution` m per pixel; its corner is left, top, m."""
        zoom = resolution * self.scale
        x, y = self.to_pixels(np.array([left, top])) + 0.5
        warp = np.array([[zoom, 0.0, x + 0.5 * zoom - 0.5], [0.0, zoom, y + 0.5 * zoom - 0.5]])
        if zoom < 1.0:  # average, because cells smaller than a pixel would vanish
            rows, columns = (max(1, round(side * zoom)) for side in image.shape[:2])
            image = np.asarray(
                cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8
            )
            warp = np.array([[1.0, 0.0, round(x)], [0.0, 1.0, round(y)]])
        size = self.pixels.shape[1::-1]
        options = {"flags": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_TRANSPARENT}
        cv2.warpAffine(image, warp, size, dst=self.pixels, **options)

    def line(self, points: Array, code: str, width: float, closed: bool = False) -> None:
        """Draw a polyline through points (n, 2) m, `width` pixels wide."""
        cv2.polylines(
            *(self.pixels, [self._fixed_point(points)], closed, colour(code), max(1, round(width))),
            *(cv2.LINE_AA, FRACTION_BITS),
        )

    def dashes(self, points: Array, code: str, width: float, dash: float, gap: float) -> None:
        """Draw a polyline of dashes and gaps, in pixels."""
        steps = np.hypot(*np.diff(points, axis=0).T) * self.scale
        length = np.concatenate([[0.0], np.cumsum(steps)])
        for begin in np.arange(0.0, length[-1], dash + gap):
            end = min(begin + dash, length[-1])
            stops = np.unique([begin, *length[(length > begin) & (length < end)], end])
            self.line(np.column_stack([np.interp(stops, length, c) for c in points.T]), code, width)

    def fill(self, outline: Array, code: str) -> None:
        """Fill a convex outline (n, 2) m."""
        cv2.fillConvexPoly(
            self.pixels, self._fixed_point(outline), colour(code), cv2.LINE_AA, FRACTION_BITS
        )

    def fade(self, before: Picture, opacity: float) -> None:
        """Apply an opacity to what was drawn since `before`, a copy of the pixels."""
        cv2.addWeighted(self.pixels, opacity, before, 1.0 - opacity, 0.0, dst=self.pixels)

    def label(self, at: Array, text: str, code: str, size: float, ground: str = "") -> None:
        """Write an ASCII text (the font has no other characters), its lower left corner at (2,) m."""
        (x, y), (width, height) = np.round(self.to_pixels(at)).astype(int), text_size(text, size)
        if ground:
            corners = (int(x) - 3, int(y) - height - 4), (int(x) + width + 3, int(y) + 4)
            cv2.rectangle(self.pixels, *corners, colour(ground), cv2.FILLED)
        style = FONT, size, colour(code), 1, cv2.LINE_AA
        cv2.putText(self.pixels, text, (int(x), int(y)), *style)

    def _fixed_point(self, points: Array) -> npt.NDArray[np.int32]:
        return np.round(self.to_pixels(points) * (1 << FRACTION_BITS)).astype(np.int32)


def text_size(text: str, size: float) -> tuple[int, int]:
    """Return width and height of a text in pixels."""
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    return int(width), int(height)


def png(picture: Picture) -> bytes:
    """Return a picture as a PNG file."""
    done, data = cv2.imencode(".png", picture)
    assert done, "a PNG of any size can be encoded"
    return data.tobytes()
