"""Corners at which two walls really meet."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.line_segments import Segments
from impslam.extractors.segmentation import beam_spacing
from impslam.extractors.split_merge import StraightPieces, covariances
from impslam.geometry.angles import wrap
from impslam.types import Array, Ints, Observation, Scan

_NOISE = 3.0  # standard deviations


@register("corner")
class Corner(StraightPieces):
    """Corners, concave and convex: intersections of neighbouring straight pieces that meet.

    Few but reliable: both pieces must end at the intersection, within beam spacing and noise.
    Attributes: "angle", the opening of the free space (rad, below pi in a room's corner, above pi at a
    pillar's), and "heading", its bisector in base_link (rad).
    """

    landmark = "corner"

    min_length: float = parameter(
        0.3, "m", "Shortest side; boxes and door frames are smaller.", gt=0.0
    )
    min_angle: float = parameter(
        math.radians(50.0),
        "rad",
        "Smallest angle between the sides' lines; flatter ones meet anywhere along a wall.",
        gt=0.0,
        le=math.pi / 2.0,
    )
    reach: float = parameter(
        0.03,
        "m",
        "Largest distance of a side's end from the intersection; skirting and mouldings.",
        ge=0.0,
    )
    max_sigma: float = parameter(
        0.05, "m", "Largest standard deviation of the corner in any direction.", gt=0.0
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the corners of the scan; see `Extractor.extract`."""
        del rng
        segments, good = self._pieces(scan)
        P = covariances(segments, 0.0, self.flatness)
        corners = [self._corner(segments, P, pair, scan) for pair in self._pairs(segments, good)]
        return [corner for corner in corners if corner is not None]

    def _pairs(self, segments: Segments, first: Ints) -> Iterator[tuple[int, int]]:
        """Return neighbouring pieces at an angle of at least `min_angle`."""
        second = np.concatenate((first[1:], first[:1]))
        alpha = segments.lines[:, 1]
        steep = np.abs(np.sin(alpha[second] - alpha[first])) >= math.sin(self.min_angle)
        return zip(first[steep].tolist(), second[steep].tolist(), strict=True)

    def _corner(
        self, segments: Segments, P: Array, pair: tuple[int, int], scan: Scan
    ) -> Observation | None:
        a, b = pair
        one, two = segments.lines[a].tolist(), segments.lines[b].tolist()
        c1, s1, c2, s2 = math.cos(one[1]), math.sin(one[1]), math.cos(two[1]), math.sin(two[1])
        det = c1 * s2 - s1 * c2
        x, y = (s2 * one[0] - s1 * two[0]) / det, (c1 * two[0] - c2 * one[0]) / det
        point = np.array([x, y])
        sigma = float(scan.sigmas[segments.index[(segments.label == b).argmax()]])
        if not (
            self._meets(point, segments.end_points[a, 1], (c1, s1), sigma, scan)
            and self._meets(point, segments.end_points[b, 0], (c2, s2), sigma, scan)
        ):
            return None
        # n . p = rho, so N dp = drho - (t . p) dalpha, with t the normal rotated left.
        J = np.array(
            [
                [s2 / det, -s2 * (c1 * y - s1 * x) / det, -s1 / det, s1 * (c2 * y - s2 * x) / det],
                [-c2 / det, c2 * (c1 * y - s1 * x) / det, c1 / det, -c1 * (c2 * y - s2 * x) / det],
            ]
        )
        shared = scan.bias * (J @ np.array(one[5:7] + two[5:7]))
        R: Array = np.outer(shared, shared)
        for side, k in ((J[:, :2], a), (J[:, 2:], b)):
            R += side @ P[k] @ side.T
        if _largest_eigenvalue(R) > self.max_sigma**2:
            return None
        beams = np.concatenate((segments.beams(a), segments.beams(b)))
        far_ends = np.array([segments.end_points[a, 0], segments.end_points[b, 1]])
        shape = _shape(point, far_ends, scan.laser[:2])
        return Observation("corner", point, R, beams, None, shape, shared=shared)

    def _meets(
        self, point: Array, end: Array, normal: tuple[float, float], sigma: float, scan: Scan
    ) -> bool:
        """Return whether a side ends at the intersection, within beam spacing and noise."""
        dx, dy = float(end[0] - scan.laser[0]), float(end[1] - scan.laser[1])
        distance = max(math.hypot(dx, dy), 1e-9)
        cosine = abs(dx * normal[0] + dy * normal[1]) / distance
        step = 2.0 * distance * beam_spacing(scan) / max(cosine, 0.1)
        noise = _NOISE * sigma
        gap = math.hypot(float(end[0] - point[0]), float(end[1] - point[1]))
        return gap <= self.reach + step + noise


def _largest_eigenvalue(R: Array) -> float:
    """Return the larger eigenvalue of a symmetric (2, 2) matrix."""
    half = 0.5 * float(R[0, 0] + R[1, 1])
    return half + math.hypot(0.5 * float(R[0, 0] - R[1, 1]), float(R[0, 1]))


def _shape(point: Array, far_ends: Array, laser: Array) -> dict[str, float]:
    """Return the opening and the heading of the free space, which contains the laser."""
    (ax, ay), (bx, by) = (far_ends - point).tolist()
    lx, ly = (laser - point).tolist()
    a, b = math.hypot(ax, ay), math.hypot(bx, by)
    cross = ax * by - ay * bx
    angle = abs(math.atan2(cross, ax * bx + ay * by))
    heading = math.atan2(ay / a + by / b, ax / a + bx / b)
    # In the wedge between the sides the laser is a positive combination of both.
    if (lx * by - ly * bx) * cross < 0.0 or (ax * ly - ay * lx) * cross < 0.0:
        angle, heading = 2.0 * math.pi - angle, wrap(heading + math.pi)
    return {"angle": angle, "heading": heading}
