"""Chains of uncertain motions, for compiled loops: poses [x, y, theta] with additive errors.

With T_a_c = T_a_b * T_b_c the errors of both parts propagate by the derivatives of `se2.compose`
(Smith, Self and Cheeseman 1990, Eq. 17), here written out for their few non-zero entries.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


@kernel
def advance(pose: Array, P: Array, d_pose: Array, Q: Array) -> None:
    """Compose pose (3,) and P (3, 3) with a motion d_pose (3,) of covariance Q (3, 3), in place."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = c * d_pose[0] - s * d_pose[1], s * d_pose[0] + c * d_pose[1]
    xx, xy, xt = P[0, 0], P[0, 1], P[0, 2]
    yy, yt, tt = P[1, 1], P[1, 2], P[2, 2]
    P[0, 0] = xx - 2.0 * dy * xt + dy * dy * tt
    P[0, 1] = xy + dx * xt - dy * yt - dx * dy * tt
    P[0, 2] = xt - dy * tt
    P[1, 1] = yy + 2.0 * dx * yt + dx * dx * tt
    P[1, 2] = yt + dx * tt
    P[0, 0] += c * c * Q[0, 0] - 2.0 * c * s * Q[0, 1] + s * s * Q[1, 1]
    P[0, 1] += c * s * (Q[0, 0] - Q[1, 1]) + (c * c - s * s) * Q[0, 1]
    P[0, 2] += c * Q[0, 2] - s * Q[1, 2]
    P[1, 1] += s * s * Q[0, 0] + 2.0 * c * s * Q[0, 1] + c * c * Q[1, 1]
    P[1, 2] += s * Q[0, 2] + c * Q[1, 2]
    P[2, 2] += Q[2, 2]
    P[1, 0], P[2, 0], P[2, 1] = P[0, 1], P[0, 2], P[1, 2]
    pose[0] += dx
    pose[1] += dy
    pose[2] = wrap_in_kernel(pose[2] + d_pose[2])


@kernel
def advance_pose(pose: Array, d_pose: Array) -> None:
    """Compose pose (3,) with a motion d_pose (3,), in place."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    pose[0] += c * d_pose[0] - s * d_pose[1]
    pose[1] += s * d_pose[0] + c * d_pose[1]
    pose[2] = wrap_in_kernel(pose[2] + d_pose[2])
