"""Walls by split and merge, with thresholds from the beams' noise."""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter, register
from impslam.extractors.base import Extractor
from impslam.extractors.line_segments import Segments, find_segments
from impslam.extractors.segmentation import segment
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Observation, Scan


def segments_of(scan: Scan, flatness: float, gap: float) -> Segments:
    """Return the straight pieces of a scan of any length; computed once per scan."""
    return scan.derive(_segments, flatness, gap)


def _segments(scan: Scan, flatness: float, gap: float) -> Segments:
    return find_segments(segment(scan), flatness, gap)


class StraightPieces(Extractor):
    """Base class of extractors that use straight pieces."""

    min_length: float = parameter(0.4, "m", "shortest piece", gt=0.0)
    min_points: int = parameter(
        6,
        "1",
        "minimum number of beams on a piece; from 6 on residuals distinguish a line from a curve",
        ge=3,
    )
    flatness: float = parameter(
        0.005,
        "m",
        "standard deviation of a wall from a straight line; finished walls are within 5 mm over 1 m",
        ge=0.0,
    )
    gap: float = parameter(
        1.0, "m", "widest occlusion across which collinear pieces are one wall", ge=0.0
    )
    max_chi2: float = parameter(
        3.0, "1", "largest mean squared residual, in variances, of a straight surface", gt=1.0
    )

    def _pieces(self, scan: Scan) -> tuple[Segments, Ints]:
        """Return the straight pieces of a scan, and which are long and straight enough."""
        segments = segments_of(scan, self.flatness, self.gap)
        return segments, np.flatnonzero(
            (segments.lengths >= self.min_length)
            & (segments.counts >= self.min_points)
            & (segments.reduced_chi2 <= self.max_chi2)
        )


@register("split_merge")
class SplitMerge(StraightPieces):
    """Walls by split and merge: range gaps, corners, a merge of collinear pieces, an ML line fit.

    The default for walls. A segment between two gaps is split at a point off its chord,
    or where two lines explain it better than one, by more than noise and flatness allow; pieces
    that are collinear by their covariances are merged unless a beam passed between them.
    """

    landmark = "wall"

    min_length: float = parameter(
        0.4, "m", "shortest wall; legs, boxes and cylinders are narrower", gt=0.0
    )

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the walls of the scan; see `Extractor.extract`."""
        del rng
        segments, good = self._pieces(scan)
        P = covariances(segments, scan.bias, self.flatness)
        z, R, slopes = _oriented_walls(segments.lines, P, scan.laser)
        shared = scan.bias * slopes
        return [
            Observation(
                "wall", z[k], R[k], segments.beams(k), segments.end_points[k], shared=shared[k]
            )
            for k in good.tolist()
        ]


def covariances(segments: Segments, bias: float, flatness: float) -> Array:
    """Return the covariances (k, 2, 2) of [rho, alpha] of the pieces.

    They include the noise of the beams (scaled up if the residuals are larger), the error common to all
    ranges, and the wall's own shape: an uncertainty of `flatness` at each end.
    """
    sizes = segments.lengths, segments.reduced_chi2
    return _covariances(segments.lines, segments.end_points, sizes, bias, flatness * flatness)


@kernel
def _covariances(
    lines: Array, ends: Array, sizes: tuple[Array, Array], bias: float, flat2: float
) -> Array:
    (lengths, reduced_chi2), out = sizes, np.empty((len(lines), 2, 2))
    for k in range(len(lines)):
        _, alpha, rr, ra, aa, b_r, b_a, _ = lines[k]
        x, y = ends[k, 0, 0] + ends[k, 1, 0], ends[k, 0, 1] + ends[k, 1, 1]
        arm = 0.5 * (math.cos(alpha) * y - math.sin(alpha) * x)
        length = max(lengths[k], 1e-9)  # some pieces are points
        scale, tilt = max(1.0, reduced_chi2[k]), 2.0 * flat2 / length**2
        off = scale * ra + bias * bias * b_r * b_a + arm * tilt
        out[k, 0, 0] = scale * rr + bias * bias * b_r * b_r + 0.5 * flat2 + arm * arm * tilt
        out[k, 0, 1], out[k, 1, 0] = off, off
        out[k, 1, 1] = scale * aa + bias * bias * b_a * b_a + tilt
    return out


@kernel
def _oriented_walls(lines: Array, P: Array, laser: Array) -> tuple[Array, Array, Array]:
    """Return z (k, 2) and R (k, 2, 2) of walls whose normals point away from the laser.

    The last value (k, 2) is the derivative of z by an error common to all ranges.
    """
    z, R, slopes = np.empty((len(lines), 2)), P.copy(), lines[:, 5:7].copy()
    for k in range(len(lines)):
        rho, alpha = lines[k, 0], lines[k, 1]
        if rho - math.cos(alpha) * laser[0] - math.sin(alpha) * laser[1] < 0.0:
            rho, alpha = -rho, alpha + math.pi
            R[k, 0, 1], R[k, 1, 0] = -R[k, 0, 1], -R[k, 1, 0]
            slopes[k, 0] = -slopes[k, 0]
        z[k, 0], z[k, 1] = rho, wrap_in_kernel(alpha)
    return z, R, slopes
