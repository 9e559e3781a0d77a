"""Walls by split and merge, each step decided by the beams' noise."""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.line_segments import Segments, find_segments
from impslam.extractors.segmentation import segment
from impslam.geometry.angles import wrap
from impslam.types import Array, Observation, Scan


def segments_of(scan: Scan, flatness: float, gap: float) -> Segments:
    """Return the straight pieces of a scan, whatever their length; computed once for a scan."""
    return scan.derive(_segments, flatness, gap)


def _segments(scan: Scan, flatness: float, gap: float) -> Segments:
    return find_segments(segment(scan), flatness, gap)


@register("split_merge")
class SplitMerge(Extractor):
    """Walls by split and merge: range gaps, corners, a merge of collinear pieces, an ML line fit.

    The default for walls. A segment between two gaps is split where a point stands off its chord,
    or where two lines explain it better than one, by more than noise and flatness allow; pieces
    that are collinear by their covariances are merged unless a beam went through between them.
    """

    landmark = "wall"

    min_length: float = parameter(
        0.4, "m", "Shortest wall; legs, boxes and cylinders are narrower.", gt=0.0
    )
    min_points: int = parameter(
        6, "1", "Fewest beams on a wall; from 6 on the residuals tell a line from a curve.", ge=3
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
    max_chi2: float = parameter(
        3.0, "1", "Largest mean squared residual, in variances, of a straight surface.", gt=1.0
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the walls of the scan; see `Extractor.extract`."""
        del rng
        found = segments_of(scan, self.flatness, self.gap)
        keep = (
            (found.lengths >= self.min_length)
            & (found.counts >= self.min_points)
            & (found.reduced_chi2 <= self.max_chi2)
        )
        return [_wall(found, int(k), scan, self.flatness) for k in np.flatnonzero(keep)]


def covariance(found: Segments, k: int, bias: float, flatness: float) -> Array:
    """Return the (2, 2) covariance of [rho, alpha] of a segment, of all that is not known of it.

    Noise of the beams (scaled up where the residuals are larger than it), the error that all
    ranges share, and the wall's own shape: each end is no better known than `flatness`.
    """
    _, alpha, rr, ra, aa, b_r, b_a, _ = found.lines[k].tolist()
    (x1, y1), (x2, y2) = found.end_points[k].tolist()
    scale = max(1.0, float(found.reduced_chi2[k]))
    arm = 0.5 * (math.cos(alpha) * (y1 + y2) - math.sin(alpha) * (x1 + x2))
    flat2 = flatness * flatness
    tilt = 2.0 * flat2 / float(found.lengths[k]) ** 2
    off = scale * ra + bias * bias * b_r * b_a + arm * tilt
    return np.array(
        [
            [scale * rr + bias * bias * b_r * b_r + 0.5 * flat2 + arm * arm * tilt, off],
            [off, scale * aa + bias * bias * b_a * b_a + tilt],
        ]
    )


def _wall(found: Segments, k: int, scan: Scan, flatness: float) -> Observation:
    """Return a segment as a wall whose normal points away from the laser."""
    rho, alpha = float(found.lines[k, 0]), float(found.lines[k, 1])
    R = covariance(found, k, scan.bias, flatness)
    from_laser = rho - math.cos(alpha) * scan.laser[0] - math.sin(alpha) * scan.laser[1]
    if from_laser < 0.0:
        rho, alpha = -rho, alpha + math.pi
        R = R * np.array([[1.0, -1.0], [-1.0, 1.0]])
    z = np.array([rho, wrap(alpha)])
    return Observation("wall", z, R, found.beams(k), found.end_points[k])
