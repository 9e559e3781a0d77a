"""De-skew the beams of a lidar: transform them to base_link at one instant.

The beams of a sweep are fired while the robot moves. With a constant body twist xi the robot is at
exp(t xi) when a beam is fired t seconds after the middle of the sweep; the beam's origin and end point are
transformed by that motion.

A beam is valid if its direction is within the field of view, and its range is positive, not below
range_min, and below range_max (REP 117). If nothing returns, drivers report 0, infinity, or exactly
range_max, at which a surface hardly ever is; lidars report error codes below their smallest range.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import sinc_cosc
from impslam.types import Array, Mask


class RangeCalibration(NamedTuple):
    """How received ranges become metres.

    Attributes
    ----------
    scale, offset : m per received unit, and m
    low, high : limits of the received ranges
    sigma, sigma_per_m : standard deviation of a range at 0 (m), and its increase per metre of range
    """

    scale: float
    offset: float
    low: float
    high: float
    sigma: float
    sigma_per_m: float


@kernel
def deskew_sweeps(
    ranges: Array,
    beams: Array,
    in_field: Mask,
    twists: Array,
    mount: Array,
    calibration: RangeCalibration,
) -> tuple[Array, Mask, Array, Array, Array, Array]:
    """Return sweeps of n beams in base_link at the middle of each.

    Parameters
    ----------
    ranges : (m, n) as received
    beams : (n, 2) rad and s; angle about the z axis of base_link, 0 ahead of the laser, and time after the
        middle of the sweep
    in_field : (n,) which beams are within the field of view
    twists : (m, 3) m/s, m/s, rad/s, of the body over each sweep
    mount : (3,) `T_base_laser`
    calibration : of the ranges

    Returns
    -------
    ranges, valid, points, directions, origins, sigmas : the fields of `Scans`
    """
    m, n = ranges.shape
    calibrated, valid, sigmas = np.empty((m, n)), np.empty((m, n), np.bool_), np.empty((m, n))
    points, directions, origins = np.empty((m, n, 2)), np.empty((m, n)), np.empty((m, n, 2))
    heading = mount[2] + beams[:, 0]
    cosines, sines = np.cos(heading), np.sin(heading)
    for k in range(m):
        vx, vy, omega = twists[k]
        for i in range(n):
            r = ranges[k, i]
            usable = in_field[i] and calibration.low <= r < calibration.high and r > 0.0
            r = calibration.scale * r + calibration.offset
            usable = usable and r > 0.0
            r = r if usable else 0.0
            t = beams[i, 1]
            theta = omega * t
            a, b = sinc_cosc(theta)
            c, s = 1.0 - theta * b, theta * a
            x = t * (a * vx - b * vy) + c * mount[0] - s * mount[1]
            y = t * (b * vx + a * vy) + s * mount[0] + c * mount[1]
            calibrated[k, i], valid[k, i] = r, usable
            sigmas[k, i] = calibration.sigma + calibration.sigma_per_m * r
            directions[k, i] = theta + heading[i]
            origins[k, i, 0], origins[k, i, 1] = x, y
            points[k, i, 0] = x + r * (c * cosines[i] - s * sines[i])
            points[k, i, 1] = y + r * (s * cosines[i] + c * sines[i])
    return calibrated, valid, points, directions, origins, sigmas
