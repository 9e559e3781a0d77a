"""Walls by OpenCV's Hough transform of the scan as an image (thesis 4.2.4)."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar, Self

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import model_validator

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.readings import in_beam_order, usable, wall_observation
from impslam.types import Array, Mask, Observation, Scan


@lru_cache(maxsize=8)
def _bias(size: int, bins: float, angle_bin: float) -> float:
    """Return the distance that OpenCV reports for the image's first column, which is at 0, in px.

    Some versions (4.10, not 4.14) count votes about bin (count - 1) // 2 and report distances from
    (count - 1) / 2, which differ by half a bin if the number of bins is even.
    """
    image = np.zeros((size, size), np.uint8)
    image[:, 0] = 255
    found = cv2.HoughLines(image, bins, angle_bin, size - 1)
    return 0.0 if found is None else float(np.asarray(found).flat[0])


MAX_CELLS = 1e7
"""Cells of the accumulator, 40 MB: the thesis has 36 000; bins of 1 cm and 1 deg over 10 m, 720 000."""


@register("hough")
class Hough(Extractor):
    """Walls by the Hough transform of a raster image of the scan (thesis 4.2.4).

    Points become white pixels of a square binary image with the robot in its middle (Eq. 4.13);
    cv2.HoughLines finds the cells of distance and angle with more pixels than the threshold,
    and two points of every line are transformed back by the inverse of Eq. 4.13. Points
    outside the image are ignored.

    The thesis relies on wide bins to find a wall only once. A wall at an angle between two bins
    still gives several peaks, so here a line, strongest first, takes the readings that its cell of
    the accumulator cannot distinguish from it: those nearer than one bin of distance plus half a
    bin of angle times their distance along the line from the middle of its votes. A later line counts only
    if the remaining readings in its cell exceed the threshold, too. Walls are thus as far
    apart as the bins, as the thesis intends (5.2.2).
    """

    landmark: ClassVar[str] = "wall"

    size: int = parameter(
        1000, "px", "side of the image, the robot in its middle (thesis 4.2.4)", ge=3, le=20_000
    )
    resolution: float = parameter(
        0.01, "m", "side of a pixel (thesis 4.2.4); with the size it makes 10 m x 10 m", gt=0.0
    )
    rho_bin: float = parameter(
        0.02,
        "m",
        "resolution of the distance: nearer parallel walls are one (thesis 5.2.2)",
        gt=0.0,
    )
    angle_bin: float = parameter(
        math.pi / 18.0,
        "rad",
        "resolution of the angle: walls at less than it are one (thesis 5.2.2: 10 deg)",
        gt=0.0,
        le=math.pi / 2.0,
    )
    threshold: int = parameter(
        20,
        "px",
        "pixels in a cell that a wall must exceed: the worst wall, 5 deg off its bin of angle, "
        "crosses the 2 cm bin in 0.23 m: 23 pixels of 1 cm, if beams are that dense; a lower value finds "
        "more walls between bins or far away, and more spurious lines",
        ge=1,
    )
    sigma_rho: float = parameter(
        0.05,
        "m",
        "standard deviation of rho, thesis Eq. 4.9: the bin of distance (20 mm / sqrt 12) and that "
        "of the angle at 1 m, the typical distance of readings from the foot of the wall's normal",
        gt=0.0,
    )
    sigma_alpha: float = parameter(
        0.05,
        "rad",
        "standard deviation of alpha, thesis Eq. 4.9: 10 deg / sqrt 12, of a uniform error in a bin",
        gt=0.0,
    )

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        """Reject an accumulator that would take minutes per scan or exhaust the memory."""
        distances = 4.0 * self.size * self.resolution / self.rho_bin
        cells = distances * math.pi / self.angle_bin
        if cells > MAX_CELLS:
            raise ValueError(f"rho_bin and angle_bin make {cells:.2g} cells; make them wider")
        return self

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the walls in the order of the beams."""
        del rng
        beams = np.flatnonzero(usable(scan))
        beams = beams[self._inside(scan.points[beams])]
        free = np.ones(len(beams), dtype=bool)
        walls = []
        for rho, alpha in self._lines(self._image(scan.points[beams])):
            supporting = self._supporting(scan.points[beams], rho, alpha, free)
            if supporting is not None:
                free &= ~supporting
                sigmas = (self.sigma_rho, self.sigma_alpha)
                walls.append(wall_observation(scan, rho, alpha, beams[supporting], sigmas))
        return in_beam_order(walls)

    def _to_pixels(self, points: Array) -> Array:
        """Return (n, 2) image columns and rows, rounded (thesis Eq. 4.13)."""
        middle = self.size // 2
        x, y = points[:, 0] / self.resolution, points[:, 1] / self.resolution
        return np.rint(np.column_stack((middle - y, middle + x)))

    def _to_robot(self, pixels: Array) -> Array:
        """Return (n, 2) points in base_link, the inverse of thesis Eq. 4.13."""
        middle = self.size // 2
        return self.resolution * np.column_stack((pixels[:, 1] - middle, middle - pixels[:, 0]))

    def _inside(self, points: Array) -> Mask:
        pixels = self._to_pixels(points)
        inside = (pixels >= 0.0) & (pixels < self.size)
        return np.logical_and(inside[:, 0], inside[:, 1])

    def _image(self, points: Array) -> npt.NDArray[np.uint8]:
        columns, rows = self._to_pixels(points).astype(np.int64).T
        image = np.zeros((self.size, self.size), np.uint8)
        image[rows, columns] = 255
        return image

    def _lines(self, image: npt.NDArray[np.uint8]) -> list[tuple[float, float]]:
        """Return rho and alpha in base_link of all peaks, most votes first."""
        bins = self.rho_bin / self.resolution
        found = cv2.HoughLines(image, bins, self.angle_bin, self.threshold)
        if found is None:
            return []
        # Shapes are (n, 1, 2) in OpenCV 4 and (1, n, 2) in 5.
        peaks = np.asarray(found, np.float64).reshape(-1, np.shape(found)[-1])[:, :2]
        bias = _bias(self.size, bins, self.angle_bin)
        return [self._line(rho - bias, theta) for rho, theta in peaks]

    def _line(self, rho: float, theta: float) -> tuple[float, float]:
        """Return the normal form in base_link of a line in the image, from two of its points."""
        normal = np.array([math.cos(theta), math.sin(theta)])
        first = rho * normal
        second = first + self.size * np.array([-normal[1], normal[0]])
        (x, y), (x2, y2) = self._to_robot(np.stack((first, second)))
        alpha = math.atan2(x - x2, y2 - y)
        return x * math.cos(alpha) + y * math.sin(alpha), alpha

    def _supporting(self, points: Array, rho: float, alpha: float, free: Mask) -> Mask | None:
        """Return which free points support the line, or None if it has too few votes."""
        c, s = math.cos(alpha), math.sin(alpha)
        distance = np.abs(points[:, 0] * c + points[:, 1] * s - rho)
        position = points[:, 1] * c - points[:, 0] * s
        votes = free & (distance <= 0.5 * self.rho_bin + self.resolution / math.sqrt(2.0))
        if np.count_nonzero(votes) <= self.threshold:
            return None
        lever = np.abs(position - position[votes].mean())
        supporting: Mask = free & (
            distance <= self.rho_bin + lever * math.tan(0.5 * self.angle_bin)
        )
        return supporting
