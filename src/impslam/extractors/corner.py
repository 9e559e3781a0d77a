"""Corners where two walls really meet."""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.line_segments import Segments
from impslam.extractors.segmentation import beam_spacing
from impslam.extractors.split_merge import covariance, segments_of
from impslam.types import Array, Ints, Observation, Scan

_NOISE = 3.0  # standard deviations


@register("corner")
class Corner(Extractor):
    """Corners, concave and convex: intersections of neighbouring straight pieces that meet.

    Few and sure: both pieces end at the intersection, within what beam spacing and noise explain.
    Attributes: "angle", the free space's opening (rad, below pi in a room's corner, above pi at a
    pillar's), and "heading", its bisector in base_link (rad).
    """

    landmark = "corner"

    min_length: float = parameter(
        0.3, "m", "Shortest side; boxes and door frames are smaller.", gt=0.0
    )
    min_points: int = parameter(
        6, "1", "Fewest beams on a side; from 6 on the residuals tell a line from a curve.", ge=3
    )
    min_angle: float = parameter(
        math.radians(50.0),
        "rad",
        "Least angle between the sides' lines; flatter ones meet anywhere along a wall.",
        gt=0.0,
        le=math.pi / 2.0,
    )
    reach: float = parameter(
        0.03, "m", "Farthest end of a side from the intersection; skirting and mouldings.", ge=0.0
    )
    max_sigma: float = parameter(
        0.05, "m", "Largest standard deviation of the corner in any direction.", gt=0.0
    )
    max_chi2: float = parameter(
        3.0, "1", "Largest mean squared residual, in variances, of a straight side.", gt=1.0
    )
    flatness: float = parameter(
        0.005,
        "m",
        "Standard deviation of a wall from a straight line; finished walls keep 5 mm over 1 m.",
        ge=0.0,
    )
    gap: float = parameter(
        1.0, "m", "Widest hidden stretch across which collinear pieces are one wall.", ge=0.0
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the corners of the scan; see `Extractor.extract`."""
        del rng
        found = segments_of(scan, self.flatness, self.gap)
        pairs = self._pairs(found)
        corners = [self._corner(found, int(a), int(b), scan) for a, b in pairs]
        return [corner for corner in corners if corner is not None]

    def _pairs(self, found: Segments) -> Ints:
        """Return (p, 2) neighbouring pieces with the length, straightness and angle of corners."""
        good = (
            (found.lengths >= self.min_length)
            & (found.counts >= self.min_points)
            & (found.reduced_chi2 <= self.max_chi2)
        )
        first = np.flatnonzero(good)
        pairs = np.column_stack((first, np.roll(first, -1)))
        turn = found.lines[pairs[:, 1], 1] - found.lines[pairs[:, 0], 1]
        steep: Ints = pairs[np.abs(np.sin(turn)) >= math.sin(self.min_angle)]
        return steep

    def _corner(self, found: Segments, a: int, b: int, scan: Scan) -> Observation | None:
        lines = found.lines[[a, b]]
        normals = np.column_stack((np.cos(lines[:, 1]), np.sin(lines[:, 1])))
        inverse = np.linalg.inv(normals)
        point: Array = inverse @ lines[:, 0]
        near = np.array([found.end_points[a, 1], found.end_points[b, 0]])
        if not self._meet(point, near, normals, scan):
            return None
        # n . p = rho, so N dp = drho - (t . p) dalpha, t being the normal turned left.
        levers = normals[:, 0] * point[1] - normals[:, 1] * point[0]
        R, shift = np.zeros((2, 2)), np.zeros(2)
        for side, k in enumerate((a, b)):
            J = np.outer(inverse[:, side], [1.0, -levers[side]])
            R += J @ covariance(found, k, 0.0, self.flatness) @ J.T
            shift += J @ lines[side, 5:7]
        R += scan.bias**2 * np.outer(shift, shift)
        if np.linalg.eigvalsh(R)[1] > self.max_sigma**2:
            return None
        far = np.array([found.end_points[a, 0], found.end_points[b, 1]])
        beams = np.concatenate((found.beams(a), found.beams(b)))
        return Observation("corner", point, R, beams, None, _shape(point, far, scan.laser[:2]))

    def _meet(self, point: Array, near: Array, normals: Array, scan: Scan) -> bool:
        """Tell whether both sides end at the intersection, but for beam spacing and noise."""
        sight = near - scan.laser[:2]
        distance = np.hypot(sight[:, 0], sight[:, 1])
        cosine = np.abs(np.sum(sight * normals, axis=1)) / np.maximum(distance, 1e-9)
        step = 2.0 * distance * beam_spacing(scan) / np.maximum(cosine, 0.1)
        noise = _NOISE * float(np.median(scan.sigmas[scan.valid]))
        gaps = np.hypot(near[:, 0] - point[0], near[:, 1] - point[1])
        return bool(np.all(gaps <= self.reach + step + noise))


def _shape(point: Array, far: Array, laser: Array) -> dict[str, float]:
    """Return the opening and the heading of the free space, on whose side the laser is."""
    sides = far - point
    sides /= np.hypot(sides[:, 0], sides[:, 1])[:, None]
    angle = math.acos(float(np.clip(sides[0] @ sides[1], -1.0, 1.0)))
    bisector = sides[0] + sides[1]
    if np.any(np.linalg.solve(sides.T, laser - point) < 0.0):
        angle, bisector = 2.0 * math.pi - angle, -bisector
    return {"angle": angle, "heading": math.atan2(bisector[1], bisector[0])}
