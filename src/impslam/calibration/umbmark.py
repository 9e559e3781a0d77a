"""UMBmark: calibration of wheels from squares driven in both directions (Borenstein and Feng 1996).

A robot drives a square and returns to its start. With heading errors beta after each side (unequal wheels)
and -alpha after each left turn (wrong track), to first order the return position is off by
L [2 beta - 2 alpha, 2 alpha - 2 beta] counter-clockwise and by L [-2 beta - 2 alpha, -2 beta - 2 alpha]
clockwise: true minus odometry, in the frame of the start, x along the first side L. Random errors are
averaged out over several squares.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import deskewed
from impslam.calibration.odometry_models import motion
from impslam.calibration.recording import CalibrationRows
from impslam.calibration.residuals import CalibrationDrive
from impslam.calibration.scan_pairs import align, sweep_surface
from impslam.geometry.se2 import compose, inverse
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array


class Umbmark(NamedTuple):
    """Result of UMBmark.

    Attributes
    ----------
    diameters : right over left wheel diameter, E_d, as a factor on the present one
    track : true over present track, E_b
    error : m, the larger distance of the two mean return positions from the true ones, E_max,syst
    """

    diameters: float
    track: float
    error: float


def umbmark(clockwise: Array, counter: Array, side: float, track: float) -> Umbmark:
    """Return the result for return errors (n, 2) and (m, 2), m; `side` and `track` in m."""
    cw, ccw = clockwise.mean(axis=0), counter.mean(axis=0)
    # Missing turn at a corner, and turn to the left along a side, rad.
    alpha, beta = (cw[0] + ccw[0]) / (-4.0 * side), (cw[0] - ccw[0]) / (-4.0 * side)
    curvature = 2.0 * math.sin(0.5 * beta) / side
    diameters = (1.0 + 0.5 * track * curvature) / (1.0 - 0.5 * track * curvature)
    turn = 0.5 * math.pi
    error = max(float(np.hypot(*cw)), float(np.hypot(*ccw)))
    return Umbmark(diameters, turn / (turn - float(alpha)), error)


def corrected(found: Umbmark, values: Array) -> Array:
    """Return `DifferentialDrive`'s parameters (3,) corrected; the mean diameter stays."""
    radius, ratio, track = values
    new = ratio * found.diameters
    return np.array([radius * (1.0 + ratio) / (1.0 + new), new, track * found.track])


class Square(NamedTuple):
    """A square: its return position, true minus odometry, (2,) m, and whether it turned left."""

    error: Array
    is_left: bool


def measure_square(
    lidar: Lidar2D, recording: CalibrationRows, drive: CalibrationDrive, values: Array
) -> Square | None:
    """Measure the return error of a square by its first and last scan; None if they do not match.

    `values` are the odometry parameters (3,).
    """
    path = drive.path
    assert path is not None
    ends = np.array([0, len(path.middles) - 1])
    sweeps = deskewed(lidar, recording.scans, path, ends)
    first, last = (sweep_surface(scans, k) for scans in sweeps for k in range(len(scans.stamps)))
    found = align(first, last, np.zeros(3), (lidar.sigma, lidar.sigma_per_m))
    if found is None:
        return None
    mount, times = np.array(lidar.mount), path.middles[ends]
    true = compose(compose(mount, found.T_a_b), inverse(mount))
    odometry = motion(drive.model, values, lidar.latency, times[:1], times[1:])
    position = np.array([odometry.translation[0].real, odometry.translation[0].imag])
    return Square(true[:2] - position, bool(odometry.turn[0] > 0.0))
