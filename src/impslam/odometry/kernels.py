"""Kernels that compute motions along arcs from odometry readings.

A body that travels a distance d while it turns by a at a constant rate moves by exp([d, 0, a]) in SE(2):
[d sin(a)/a, d (1 - cos(a))/a, a].
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import sinc_cosc
from impslam.types import Array

_SMALL = 1e-3
"""rad: below it the series of the derivatives are exact to 1e-10, and above it closed forms to 1e-12."""


@kernel
def arc(distance: float, turn: float) -> tuple[float, float, float]:
    """Return exp([distance, 0, turn])."""
    s, c = sinc_cosc(turn)
    return distance * s, distance * c, wrap_in_kernel(turn)


@kernel
def differential_drive(left: float, right: float, track: float) -> tuple[Array, Array]:
    """Return the increment (3,) of two wheel travels in m, and its Jacobian (3, 2) by them."""
    d, a = 0.5 * (left + right), (right - left) / track
    s, c = sinc_cosc(a)
    if abs(a) < _SMALL:
        s_D_a, c_D_a = -a / 3.0, 0.5 - a * a / 8.0
    else:
        s_D_a, c_D_a = (1.0 - s) / a - c, s - c / a
    J = np.empty((3, 2))
    for j, sign in enumerate((-1.0, 1.0)):
        J[0, j] = 0.5 * s + sign * d * s_D_a / track
        J[1, j] = 0.5 * c + sign * d * c_D_a / track
        J[2, j] = sign / track
    return np.array([d * s, d * c, wrap_in_kernel(a)]), J


@kernel
def wheel_motions(left: Array, right: Array, track: float, variance: float) -> tuple[Array, Array]:
    """Return increments (m, 3) of wheel travels (m,) and their covariances (m, 3, 3).

    `variance` is that of a wheel's travel per metre (thesis Eq. 3.19), independent between wheels.
    """
    d_poses, covariance = np.empty((len(left), 3)), np.zeros((len(left), 3, 3))
    for k in range(len(left)):
        d_poses[k], J = differential_drive(left[k], right[k], track)
        for w in range(2):
            of_wheel = variance * abs(left[k] if w == 0 else right[k])
            for i in range(3):
                for j in range(3):
                    covariance[k, i, j] += of_wheel * J[i, w] * J[j, w]
    return d_poses, covariance


@kernel
def bicycle(wheel_travel: float, angle: float, wheelbase: float, offset: float) -> Array:
    """Return the rear axle's increment (3,) from a rear wheel's travel (m) and the steering (rad)."""
    curvature = math.tan(angle) / wheelbase
    distance = wheel_travel / (1.0 - offset * curvature)
    x, y, theta = arc(distance, distance * curvature)
    return np.array([x, y, theta])


@kernel
def axle_motions(travel: Array, angles: Array, wheelbase: float, offset: float) -> Array:
    """Return the rear axle's increments (m, 3); see `bicycle`."""
    d_poses = np.empty((len(travel), 3))
    for k in range(len(travel)):
        d_poses[k] = bicycle(travel[k], angles[k], wheelbase, offset)
    return d_poses


@kernel
def carried(d_axle: Array, axle: Array) -> tuple[Array, Array]:
    """Return the increment (3,) of base_link from that of the axle at `axle` (2,) on it.

    The second value is its Jacobian (3, 3) by the axle's increment.
    """
    c, s = math.cos(d_axle[2]), math.sin(d_axle[2])
    x, y = c * axle[0] - s * axle[1], s * axle[0] + c * axle[1]
    d_base = np.array([d_axle[0] + axle[0] - x, d_axle[1] + axle[1] - y, d_axle[2]])
    return d_base, np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])


@kernel
def carry(d_axle: Array, variances: Array, axle: Array) -> tuple[Array, Array]:
    """Return base_link's increments (m, 3) and covariances (m, 3, 3) from those of the axle.

    `variances` (m, 3) are those of the axle's increments, along, across and of the heading.
    """
    m = len(d_axle)
    d_poses, covariance = np.empty((m, 3)), np.zeros((m, 3, 3))
    for k in range(m):
        d_poses[k], J = carried(d_axle[k], axle)
        for i in range(3):
            for j in range(3):
                for n in range(3):
                    covariance[k, i, j] += J[i, n] * variances[k, n] * J[j, n]
    return d_poses, covariance
