"""Information of a match about the pose, and the drift of matched motion, as 3 x 3 matrices."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.algebra import eigenvalues, solve
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array

POWER_ITERATIONS = 4  # from an initial direction that is right but for a pure turn


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
def discount_spurious(H: Array, S: Array, W: Array, guess: Array, pose: Array) -> None:
    """Subtract spurious information S (3, 3) from that of a scan, H (3, 3), and correct its pose (3,).

    `pose` fits the scan and a prior of information W (3,) at `guess` (3,). S is subtracted along the
    direction u of which it determines the largest share, and at most what H has there. The scan's own
    optimum remains, so the pose moves towards the prior.
    """
    weakest, _, axis = information(H)
    if not weakest > 0.0:
        return
    x, y = math.cos(axis), math.sin(axis)
    u = np.array([x, y, -(H[0, 2] * x + H[1, 2] * y) / H[2, 2]])
    for _ in range(POWER_ITERATIONS):
        u = S @ u
        if not solve(H, u):
            return
    Hu = H @ u
    h = np.dot(u, Hu)
    if not h > 0.0:
        return
    share = min(np.dot(u, S @ u) / h, 1.0)
    pull = u[0] * W[0] * (pose[0] - guess[0]) + u[1] * W[1] * (pose[1] - guess[1])
    pull += u[2] * W[2] * wrap_in_kernel(pose[2] - guess[2])
    step = share * pull / h * Hu
    H -= share / h * np.outer(Hu, Hu)
    if solve(H + np.diag(W), step):
        pose -= step
        pose[2] = wrap_in_kernel(pose[2])


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
