"""Check for an error that all ranges share, as of a lidar whose zero is not at its axis.

Beams that hit a surface from two places have different directions, so such an error moves their end points
differently. The scans fit each other best once it is corrected; see `calibration.scan_pairs`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.calibration.scan_pairs import PAIR_DISTANCE, SHAPE_SIGMA, motions_of
from impslam.diagnosis.aligned_pairs import MIN_PAIRS
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding, is_off, probability_off
from impslam.diagnosis.robust import fit
from impslam.sensors.lidar2d import Lidar2D

MIN_DISTANCE = 0.5 * PAIR_DISTANCE
"""m between the scans of a pair; from closer places, surfaces are hit in almost the same directions."""
TOLERANCE = 3.0
"""Tolerated error, in standard deviations of the bias that the config states."""
MAX_ITERATIONS = 4
"""Matches with the offset found so far: if it is large, one match finds three quarters of it."""


def check_range_offset(e: Evidence) -> Iterator[Finding]:
    """Find an offset of the ranges beyond the bias that the config states."""
    lidar, allowed = e.lidar, TOLERANCE * e.lidar.bias
    for _ in range(MAX_ITERATIONS):
        found = _estimate(lidar, e)
        if found is None:
            return
        change, sigma = found
        lidar = lidar.model_copy(update={"range_offset": lidar.range_offset + change})
        offset = lidar.range_offset - e.lidar.range_offset
        if not is_off(offset, sigma, allowed):
            return
        if abs(change) < sigma:
            break
    size = "long" if offset < 0.0 else "short"
    yield Finding(
        "range offset",
        f"ranges are {abs(offset):.3f} ± {sigma:.3f} m too {size}: with this correction, scans from "
        "different places fit each other best",
        (f"{e.lidar_key}.range_offset={lidar.range_offset:.3f}",),
        probability_off(offset, sigma, allowed),
        lidar=e.name,
    )


def _estimate(lidar: Lidar2D, e: Evidence) -> tuple[float, float] | None:
    """Return what to add to the lidar's offset, and its standard deviation, m; None if nothing shows it."""
    motions = motions_of(e.pairs.by(lidar), e.path)
    far = np.flatnonzero(np.hypot(*motions.joint[:, :2].T) >= MIN_DISTANCE)
    if len(far) < MIN_PAIRS:
        return None
    variances = np.linalg.pinv(motions.information[far], hermitian=True)[:, 3, 3]
    weights = 1.0 / np.sqrt(np.maximum(variances, 1e-12))
    found = fit(weights[:, None], weights * motions.joint[far, 3])
    return float(found.p[0]), math.hypot(float(found.sigma[0]), SHAPE_SIGMA)
