"""Information of a match about the pose, and the drift of matched motion, as 3 x 3 matrices."""

from __future__ import annotations

import math

from impslam.geometry.algebra import eigenvalues
from impslam.geometry.kernels import kernel
from impslam.types import Array

NORMAL_ERROR = 3.0
"""rad/m: error of a normal by the distance of smoothed points from the surfaces of the map; 2.7 and 3.4 in
two recorded buildings, more if the ranges are noisier."""
MAX_NORMAL_ERROR = 18.0
"""rad/m: that without odometry: errors that pull along a wall change the extrapolated velocity, so they add
up from scan to scan."""
NORMAL_SIGMA = 0.03
"""rad, 1 sigma: error of a normal from three points 0.25 m apart that scatter by 1 cm."""


@kernel
def information(H: Array) -> tuple[float, float, float]:
    """Return the smallest and largest information of H (3, 3) about the position, heading unknown, 1/m^2.

    The third value is the direction of the smallest, rad.
    """
    if not H[2, 2] > 0.0:
        return 0.0, 0.0, 0.0
    xx, yy = H[0, 0] - H[0, 2] ** 2 / H[2, 2], H[1, 1] - H[1, 2] ** 2 / H[2, 2]
    xy = H[0, 1] - H[0, 2] * H[1, 2] / H[2, 2]
    weakest, strongest = eigenvalues(xx, xy, yy)
    return weakest, strongest, 0.5 * math.atan2(-2.0 * xy, yy - xx)


@kernel
def remove_spurious(H: Array) -> None:
    """Subtract from H (3, 3) the spurious information along walls that errors of normals cause.

    The share `NORMAL_SIGMA`^2 of a wall's information appears along the wall and would hold the estimate
    of a robot without odometry in place. It is subtracted along the axis of the smallest information.
    """
    weakest, strongest, axis = information(H)
    add_along(H, axis, -max(min(NORMAL_SIGMA**2 * strongest, weakest), 0.0))


@kernel
def hold_along(H: Array, W: Array, normal_error: float, guess: Array, pose: Array) -> None:
    """Correct a match for the spurious information of normals: its H (3, 3), and its pose (3,).

    The square of the `normal_error` in rad, as a share of a wall's information, appears along the wall.
    Without it the match would have moved less from the predicted pose `guess`, of information W (3,), along
    that axis.
    """
    weakest, strongest, axis = information(H)
    spurious = min(normal_error**2 * strongest, weakest)
    if not spurious > 0.0:
        return
    known, prior = weakest - spurious, W[0]
    excess = 1.0 - known * (weakest + prior) / ((known + prior) * weakest)
    x, y = math.cos(axis), math.sin(axis)
    off = excess * (x * (pose[0] - guess[0]) + y * (pose[1] - guess[1]))
    pose[0] -= off * x
    pose[1] -= off * y
    add_along(H, axis, -spurious)


@kernel
def add_along(M: Array, axis: float, amount: float) -> None:
    """Add an amount along an axis (rad) to the position part of M (3, 3)."""
    x, y = math.cos(axis), math.sin(axis)
    M[0, 0] += amount * x * x
    M[0, 1] += amount * x * y
    M[1, 0] += amount * x * y
    M[1, 1] += amount * y * y


@kernel
def add_drift(motion: Array, drift: Array, covariance: Array) -> None:
    """Add the drift of a matched motion (3,) to its covariance (3, 3), in place.

    `drift` (4,) are standard deviations: m/sqrt(m) along and across the path, rad/sqrt(m), rad/sqrt(rad).
    It is the mean square of errors with heavy tails, as on ramps.
    """
    distance, turn = math.hypot(motion[0], motion[1]), abs(motion[2])
    covariance[0, 0] += drift[0] ** 2 * distance
    covariance[1, 1] += drift[1] ** 2 * distance
    covariance[2, 2] += drift[2] ** 2 * distance + drift[3] ** 2 * turn
