"""The beams of sweeps, in the form that kernels take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.columns import Scans
from impslam.geometry.kernels import kernel, plain
from impslam.surfaces.features import Features, Sampling, find_features
from impslam.types import Array, Mask


class Geometry(NamedTuple):
    """Directions of beams: pose (3,) of the laser in base_link, first angle and spacing in rad.

    The spacing of fewer than two beams is 0.
    """

    laser: Array
    first: float
    spacing: float


class BeamColumns(NamedTuple):
    """The columns of `Scans`, with ranges of 0 where invalid, and the directions of the beams.

    If `after` is not empty, `points`, `origins` and `directions` were de-skewed with the `twists` (m, 3) of
    odometry. Where a match shows another motion, they are de-skewed anew, in place.
    """

    points: Array
    valid: Mask
    ranges: Array
    origins: Array
    directions: Array
    after: Array
    twists: Array
    geometry: Geometry


def beam_columns(scans: Scans | None, m: int, twists: Array | None = None) -> BeamColumns:
    """Return the beams of m sweeps; no beams unless the sensor is a lidar.

    Without `twists`, those of the columns are zero.
    """
    twists = np.zeros((m, 3)) if twists is None else plain(twists)
    if scans is None:
        none: Array = np.zeros((m, 0))
        geometry = Geometry(np.zeros(3), 0.0, 0.0)
        ends = np.zeros((m, 0, 2))
        return BeamColumns(
            ends, none.astype(np.bool_), none, ends, none, np.zeros(0), twists, geometry
        )
    angles = scans.angles if len(scans.angles) else np.zeros(1)
    spacing = (angles[-1] - angles[0]) / max(len(angles) - 1, 1)
    return BeamColumns(
        plain(scans.points),
        np.ascontiguousarray(scans.valid),
        plain(np.where(scans.valid, scans.ranges, 0.0)),
        plain(scans.origins),
        plain(scans.directions),
        np.zeros(0) if scans.after is None else plain(scans.after),
        twists,
        Geometry(plain(scans.laser), float(angles[0]), float(spacing)),
    )


@kernel
def beams_of(beams: BeamColumns, k: int) -> tuple[Array, Array, Array, Array]:
    """Return what is de-skewed of sweep k; see `deskew`."""
    return beams.points[k], beams.origins[k], beams.directions[k], beams.after


@kernel
def find_beam_features(beams: BeamColumns, k: int, thin: float, smooth: bool, out: Features) -> int:
    """Fill `out` with the features of sweep k; return their number. See `Sampling`."""
    sampling = Sampling(abs(beams.geometry.spacing), thin, smooth)
    return find_features(
        beams.points[k], beams.valid[k], beams.ranges[k], beams.origins[k], sampling, out
    )
