"""Corners at which two walls really meet."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.line_segments import Segments
from impslam.extractors.segmentation import NOISE_SIGMAS
from impslam.extractors.split_merge import StraightPieces, covariances
from impslam.geometry.algebra import eigenvalues
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import beam_spacing
from impslam.types import Array, Ints, Observation, Scan

# Columns of a corner: both pieces; x, y; covariance xx, xy, yy; error by the bias of the ranges (2);
# angle, heading.
_COLUMNS = 11


@register("corner")
class Corner(StraightPieces):
    """Corners, concave and convex: intersections of neighbouring straight pieces that meet.

    Few but reliable: both pieces must end at the intersection, within beam spacing and noise.
    Attributes: "angle", the opening of the free space (rad, below pi in a room's corner, above pi at a
    pillar's), and "heading", its bisector in base_link (rad).
    """

    landmark = "corner"

    min_length: float = parameter(
        0.3, "m", "shortest side; boxes and door frames are smaller", gt=0.0
    )
    min_angle: float = parameter(
        math.radians(50.0),
        "rad",
        "smallest angle between the sides' lines; flatter ones meet anywhere along a wall",
        gt=0.0,
        le=math.pi / 2.0,
    )
    reach: float = parameter(
        0.03,
        "m",
        "largest distance of a side's end from the intersection; skirting and mouldings",
        ge=0.0,
    )
    max_sigma: float = parameter(
        0.05, "m", "largest standard deviation of the corner in any direction", gt=0.0
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the corners of the scan; see `Extractor.extract`."""
        del rng
        segments, good = self._pieces(scan)
        P = covariances(segments, 0.0, self.flatness)
        spacing, sine = beam_spacing(scan.angles), math.sin(self.min_angle)
        limits = _Limits(sine, self.reach, self.max_sigma, spacing, scan.bias)
        rows = _find(segments, good, P, scan.sigmas, scan.laser, limits)
        return [_corner(row, segments) for row in rows]


def _corner(row: Array, segments: Segments) -> Observation:
    """Return a row of `_find` as an observation."""
    a, b = int(row[0]), int(row[1])
    beams = np.concatenate((segments.beams(a), segments.beams(b)))
    R = row[[4, 5, 5, 6]].reshape(2, 2)
    shape = {"angle": float(row[9]), "heading": float(row[10])}
    return Observation("corner", row[2:4].copy(), R, beams, None, shape, shared=row[7:9].copy())


class _Limits(NamedTuple):
    """What counts as a corner.

    Attributes
    ----------
    min_sine : smallest sine between the sides
    reach : m, largest distance of their ends from the corner
    max_sigma : m, largest standard deviation of the corner
    spacing : rad between beams
    bias : m, standard deviation of the error common to all ranges
    """

    min_sine: float
    reach: float
    max_sigma: float
    spacing: float
    bias: float


@kernel
def _find(
    segments: Segments, good: Ints, P: Array, sigmas: Array, laser: Array, limits: _Limits
) -> Array:
    """Return a row of `_COLUMNS` for each two neighbours among the pieces `good` (g,) that meet.

    P (k, 2, 2) are the covariances of all pieces, and sigmas (n,) those of the beams.
    """
    out, count, lines = np.empty((len(good), _COLUMNS)), 0, segments.lines
    for k in range(len(good)):
        a, b = good[k], good[(k + 1) % len(good)]
        if abs(math.sin(lines[b, 1] - lines[a, 1])) < limits.min_sine:
            continue
        row = out[count]
        row[0], row[1] = a, b
        c1, s1, c2, s2 = (
            math.cos(lines[a, 1]), math.sin(lines[a, 1]), math.cos(lines[b, 1]), math.sin(lines[b, 1])
        )  # fmt: skip
        det = c1 * s2 - s1 * c2
        row[2] = (s2 * lines[a, 0] - s1 * lines[b, 0]) / det
        row[3] = (c1 * lines[b, 0] - c2 * lines[a, 0]) / det
        noise = NOISE_SIGMAS * sigmas[segments.indices[np.argmax(segments.label == b)]]
        if not (
            _meets(row[2:4], segments.end_points[a, 1], (c1, s1), laser, noise, limits)
            and _meets(row[2:4], segments.end_points[b, 0], (c2, s2), laser, noise, limits)
        ):
            continue
        _add_covariance(row, lines, P, (c1, s1, c2, s2), limits.bias)
        if eigenvalues(row[4], row[5], row[6])[1] > limits.max_sigma**2:
            continue
        _add_shape(row, segments.end_points[a, 0], segments.end_points[b, 1], laser)
        count += 1
    return out[:count]


@kernel
def _meets(
    point: Array,
    end: Array,
    normal: tuple[float, float],
    laser: Array,
    noise: float,
    limits: _Limits,
) -> bool:
    """Return whether a side ends at the intersection, within beam spacing and noise."""
    dx, dy = end[0] - laser[0], end[1] - laser[1]
    distance = max(math.hypot(dx, dy), 1e-9)
    cosine = abs(dx * normal[0] + dy * normal[1]) / distance
    step = 2.0 * distance * limits.spacing / max(cosine, 0.1)
    gap = math.hypot(end[0] - point[0], end[1] - point[1])
    return bool(gap <= limits.reach + step + noise)


@kernel
def _add_covariance(
    row: Array, lines: Array, P: Array, normals: tuple[float, float, float, float], bias: float
) -> None:
    """Fill in the covariance of the corner, and its error by the bias of the ranges."""
    a, b, x, y = int(row[0]), int(row[1]), row[2], row[3]
    c1, s1, c2, s2 = normals
    det = c1 * s2 - s1 * c2
    # n . p = rho, so N dp = drho - (t . p) dalpha, with t the normal rotated left.
    arm_a, arm_b = c1 * y - s1 * x, c2 * y - s2 * x
    J = np.array(
        [
            [s2 / det, -s2 * arm_a / det, -s1 / det, s1 * arm_b / det],
            [-c2 / det, c2 * arm_a / det, c1 / det, -c1 * arm_b / det],
        ]
    )
    for i in range(2):
        of_a = J[i, 0] * lines[a, 5] + J[i, 1] * lines[a, 6]
        row[7 + i] = bias * (of_a + J[i, 2] * lines[b, 5] + J[i, 3] * lines[b, 6])
    for column, i, j in ((4, 0, 0), (5, 0, 1), (6, 1, 1)):
        row[column] = row[7 + i] * row[7 + j]
        for side, k in ((0, a), (2, b)):
            for m in range(2):
                for n in range(2):
                    row[column] += J[i, side + m] * P[k, m, n] * J[j, side + n]


@kernel
def _add_shape(row: Array, end_a: Array, end_b: Array, laser: Array) -> None:
    """Fill in the opening and the heading of the free space, which contains the laser.

    The far ends of both sides and the laser are in base_link.
    """
    ax, ay, bx, by = end_a[0] - row[2], end_a[1] - row[3], end_b[0] - row[2], end_b[1] - row[3]
    lx, ly = laser[0] - row[2], laser[1] - row[3]
    a, b = math.hypot(ax, ay), math.hypot(bx, by)
    cross = ax * by - ay * bx
    angle = abs(math.atan2(cross, ax * bx + ay * by))
    heading = math.atan2(ay / a + by / b, ax / a + bx / b)
    # In the wedge between the sides the laser is a positive combination of both.
    if (lx * by - ly * bx) * cross < 0.0 or (ax * ly - ay * lx) * cross < 0.0:
        angle, heading = 2.0 * math.pi - angle, wrap_in_kernel(heading + math.pi)
    row[9], row[10] = angle, heading
