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

    Without odometry, `points`, `origins` and `directions` are de-skewed in place, if `after` is not empty.
    """

    points: Array
    valid: Mask
    ranges: Array
    origins: Array
    directions: Array
    after: Array
    geometry: Geometry


def beam_columns(scans: Scans | None, m: int) -> BeamColumns:
    """Return the beams of m sweeps; no beams unless the sensor is a lidar."""
    if scans is None:
        none: Array = np.zeros((m, 0))
        geometry = Geometry(np.zeros(3), 0.0, 0.0)
        ends = np.zeros((m, 0, 2))
        return BeamColumns(ends, none.astype(np.bool_), none, ends, none, np.zeros(0), geometry)
    angles = scans.angles if len(scans.angles) else np.zeros(1)
    spacing = (angles[-1] - angles[0]) / max(len(angles) - 1, 1)
    return BeamColumns(
        plain(scans.points),
        np.ascontiguousarray(scans.valid),
        plain(np.where(scans.valid, scans.ranges, 0.0)),
        plain(scans.origins),
        plain(scans.directions),
        np.zeros(0) if scans.after is None else plain(scans.after),
        Geometry(plain(scans.laser), float(angles[0]), float(spacing)),
    )


@kernel
def find_beam_features(beams: BeamColumns, k: int, thin: float, smooth: bool, out: Features) -> int:
    """Fill `out` with the features of sweep k; return their number. See `Sampling`."""
    sampling = Sampling(abs(beams.geometry.spacing), thin, smooth)
    return find_features(
        beams.points[k], beams.valid[k], beams.ranges[k], beams.origins[k], sampling, out
    )
