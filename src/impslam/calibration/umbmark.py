"""UMBmark: what squares in both directions tell of wheels (Borenstein and Feng 1996).

A robot drives a square and returns to its start. With the heading wrong by beta after each side (unequal
wheels) and by -alpha after each left turn (a wrong track), to first order the place of return is off by
L [2 beta - 2 alpha, 2 alpha - 2 beta] counter-clockwise and by L [-2 beta - 2 alpha, -2 beta - 2 alpha]
clockwise: true minus odometry, in the frame of the start, x along the first side L. Means over several
squares leave out what is random.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import deskewed
from impslam.calibration.odometry_models import motion
from impslam.calibration.recording import Recording
from impslam.calibration.residuals import Drive
from impslam.calibration.scan_pairs import align, surface_of
from impslam.geometry.se2 import compose, inverse
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array


class Umbmark(NamedTuple):
    """What squares tell.

    Attributes
    ----------
    diameters : right over left wheel diameter, E_d, as a factor on the present one
    track : true over present track, E_b
    error : m, the larger distance of the mean returns from the true ones, E_max,syst
    """

    diameters: float
    track: float
    error: float


def umbmark(clockwise: Array, counter: Array, side: float, track: float) -> Umbmark:
    """Return what returns tell, (n, 2) and (m, 2) m, true minus odometry; `side` and `track` in m."""
    cw, ccw = clockwise.mean(axis=0), counter.mean(axis=0)
    # By which a turn is short, and to the left on a side, rad.
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
    """A square: where it ended truly minus by odometry, (2,) m, and whether it turned left."""

    error: Array
    is_left: bool


def square_of(lidar: Lidar2D, recording: Recording, drive: Drive, values: Array) -> Square | None:
    """Return how far off a square ends, by its first and its last scan; None if they do not match.

    `values` are the parameters (3,) by which odometry counts.
    """
    path = drive.path
    assert path is not None
    ends = np.array([0, len(path.middles) - 1])
    shown = deskewed(lidar, recording.scans, path, ends)
    first, last = (surface_of(scans, k) for scans in shown for k in range(len(scans.stamps)))
    found = align(first, last, np.zeros(3), (lidar.sigma, lidar.sigma_per_m))
    if found is None:
        return None
    mount, times = np.array(lidar.mount), path.middles[ends]
    true = compose(compose(mount, found.T_a_b), inverse(mount))
    told = motion(drive.model, values, lidar.latency, times[:1], times[1:])
    place = np.array([told.way[0].real, told.way[0].imag])
    return Square(true[:2] - place, bool(told.turn[0] > 0.0))
