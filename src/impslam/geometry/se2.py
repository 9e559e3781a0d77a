"""Rigid motions of the plane.

A pose is `[x, y, theta]` (m, m, rad): the position and heading of a frame seen from another,
`T_a_b` being frame b in frame a. The manifold is R^2 x S^1 with the group law of SE(2). Closed forms
for `exp` and `log` follow Solà et al. 2018, "A micro Lie theory", Eq. 152-158.

All functions batch: poses are (..., 3), and leading axes broadcast as in numpy. Each is one
compiled loop over the poses, so that one pose costs little more than arithmetic on plain floats.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel, plain

Array = npt.NDArray[np.float64]

_SINGLE = (3,)  # the shape of a single pose, the most frequent case


def rotation(theta: float | Array) -> Array:
    """Return the rotation matrices (..., 2, 2) of angles (...)."""
    if isinstance(theta, float):
        x, y = math.cos(theta), math.sin(theta)
        return np.array([[x, -y], [y, x]])
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c, -s, s, c], axis=-1).reshape(*np.shape(theta), 2, 2)


def block_rotation(theta: float) -> Array:
    """Return diag(R(theta), 1), (3, 3): the rotation of additive errors of [x, y, theta]."""
    c, s = math.cos(theta), math.sin(theta)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """Return `T_a_c` (..., 3)."""
    first, second, shape = _paired(T_a_b, T_b_c)
    return _compose(first, second).reshape(shape)


def compose_jacobians(T_a_b: Array, T_b_c: Array) -> tuple[Array, Array]:
    """Return the (..., 3, 3) derivatives of `compose` by its first and its second argument."""
    first, second, shape = _paired(T_a_b, T_b_c)
    by_first, by_second = _compose_jacobians(first, second)
    return by_first.reshape(*shape, 3), by_second.reshape(*shape, 3)


def compose_uncertain(T_a_b: Array, P: Array, T_b_c: Array, Q: Array) -> tuple[Array, Array]:
    """Return `T_a_c` and its covariance to first order, from those P and Q (..., 3, 3) of its parts."""
    first, second, shape = _paired(T_a_b, T_b_c)
    pose, covariance = _compose_uncertain(first, _matrices(P, shape), second, _matrices(Q, shape))
    return pose.reshape(shape), covariance.reshape(*shape, 3)


def inverse(T_a_b: Array) -> Array:
    """Return `T_b_a` (..., 3)."""
    flat, shape = _flat(T_a_b)
    return _inverse(flat).reshape(shape)


def inverse_uncertain(T_a_b: Array, P: Array) -> tuple[Array, Array]:
    """Return `T_b_a` and its covariance to first order, from that P (..., 3, 3) of `T_a_b`."""
    T_b_a = inverse(T_a_b)
    by_first, by_second = compose_jacobians(T_a_b, T_b_a)
    # From compose(T, inverse(T)) = 0, differentiated; the second Jacobian is a rotation.
    J = np.swapaxes(by_second, -1, -2) @ by_first
    return T_b_a, np.asarray(J @ P @ np.swapaxes(J, -1, -2))


def between(T_a_b: Array, T_a_c: Array) -> Array:
    """Return `T_b_c` (..., 3): frame c seen from frame b."""
    return compose(inverse(T_a_b), T_a_c)


def transform(T_a_b: Array, points_in_b: Array) -> Array:
    """Return points given in frame b as points in frame a.

    One pose (3,) moves points of any shape (..., 2). Poses (..., 3) move k points each, (..., k, 2),
    and the leading axes broadcast.
    """
    points = np.ascontiguousarray(points_in_b, dtype=np.float64)
    if T_a_b.ndim == 1:
        return _transform(T_a_b.reshape(1, 3), points.reshape(1, -1, 2)).reshape(points.shape)
    k = points.shape[-2]
    lead = np.broadcast_shapes(T_a_b.shape[:-1], points.shape[:-2])
    poses, _ = _flat(np.broadcast_to(T_a_b, (*lead, 3)))
    points = np.ascontiguousarray(np.broadcast_to(points, (*lead, k, 2)))
    return _transform(poses, points.reshape(len(poses), k, 2)).reshape(*lead, k, 2)


def exp(twist: Array) -> Array:
    """Return the poses (..., 3) reached by moving with constant body twists [vx, vy, omega] for 1 s."""
    flat, shape = _flat(twist)
    return _exp(flat).reshape(shape)


def log(pose: Array) -> Array:
    """Return the constant body twists (..., 3) that reach the poses in 1 s; the inverse of `exp`."""
    flat, shape = _flat(pose)
    return _log(flat).reshape(shape)


def motion_lengths(motions: Array, metres_per_radian: float) -> Array:
    """Return the lengths (...) of motions (..., 3), m, where a turn of a radian counts as some metres."""
    x, y, turn = motions[..., 0], motions[..., 1], motions[..., 2]
    return np.asarray(np.hypot(x, y) + metres_per_radian * np.abs(turn))


def _flat(poses: Array) -> tuple[Array, tuple[int, ...]]:
    """Return poses (..., 3) as rows (n, 3), and their shape."""
    if poses.shape == _SINGLE:
        return poses.reshape(1, 3), _SINGLE
    poses = np.ascontiguousarray(poses, dtype=np.float64)
    return poses.reshape(-1, 3), poses.shape


def _paired(one: Array, two: Array) -> tuple[Array, Array, tuple[int, ...]]:
    """Return two batches of poses as rows (n, 3) side by side, and the shape of their broadcast."""
    if one.shape == two.shape == _SINGLE:
        return one.reshape(1, 3), two.reshape(1, 3), _SINGLE
    if one.shape != two.shape:
        one, two = (poses.copy() for poses in np.broadcast_arrays(one, two))  # writable
    first, shape = _flat(one)
    return first, _flat(two)[0], shape


def _matrices(P: Array, shape: tuple[int, ...]) -> Array:
    """Return matrices (..., 3, 3) as rows (n, 3, 3) for poses of a shape."""
    if shape == _SINGLE:
        return P.reshape(1, 3, 3)
    if P.shape != (*shape, 3):
        P = np.broadcast_to(P, (*shape, 3))
    return plain(P).reshape(-1, 3, 3)


@kernel
def _compose(first: Array, second: Array) -> Array:
    """Compose rows (n, 3)."""
    out = np.empty_like(first)
    for i in range(len(first)):
        c, s = math.cos(first[i, 2]), math.sin(first[i, 2])
        x, y = second[i, 0], second[i, 1]
        out[i, 0] = first[i, 0] + c * x - s * y
        out[i, 1] = first[i, 1] + s * x + c * y
        out[i, 2] = wrap_in_kernel(first[i, 2] + second[i, 2])
    return out


@kernel
def _compose_jacobians(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the derivatives (n, 3, 3) of rows (n, 3)."""
    n = len(first)
    by_first, by_second = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    for i in range(n):
        c, s = math.cos(first[i, 2]), math.sin(first[i, 2])
        x, y = second[i, 0], second[i, 1]
        for k in range(3):
            by_first[i, k, k] = 1.0
        by_first[i, 0, 2], by_first[i, 1, 2] = -s * x - c * y, c * x - s * y
        by_second[i, 0, 0], by_second[i, 0, 1] = c, -s
        by_second[i, 1, 0], by_second[i, 1, 1] = s, c
        by_second[i, 2, 2] = 1.0
    return by_first, by_second


@kernel
def _compose_uncertain(first: Array, P: Array, second: Array, Q: Array) -> tuple[Array, Array]:
    """Compose rows (n, 3) with covariances (n, 3, 3)."""
    out = np.zeros((len(first), 3, 3))
    by_first, by_second = _compose_jacobians(first, second)
    for n in range(len(first)):
        for J, C in ((by_first[n], P[n]), (by_second[n], Q[n])):
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        for m in range(3):
                            out[n, i, j] += J[i, k] * C[k, m] * J[j, m]
    return _compose(first, second), out


@kernel
def _inverse(poses: Array) -> Array:
    """Invert rows (n, 3)."""
    out = np.empty_like(poses)
    for i in range(len(poses)):
        x, y, theta = poses[i, 0], poses[i, 1], poses[i, 2]
        c, s = math.cos(theta), math.sin(theta)
        out[i, 0], out[i, 1], out[i, 2] = -c * x - s * y, s * x - c * y, wrap_in_kernel(-theta)
    return out


@kernel
def _transform(poses: Array, points: Array) -> Array:
    """Transform points (n, k, 2) by rows (n, 3)."""
    out = np.empty_like(points)
    for i in range(len(poses)):
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for k in range(points.shape[1]):
            x, y = points[i, k, 0], points[i, k, 1]
            out[i, k, 0] = poses[i, 0] + c * x - s * y
            out[i, k, 1] = poses[i, 1] + s * x + c * y
    return out


@kernel
def sinc_cosc(theta: float) -> tuple[float, float]:
    """Return sin(t)/t and (1 - cos(t))/t, which are 1 and 0 at t = 0.

    By the half angle, both are accurate to rounding for all t, while 1 - cos(t) cancels near 0.
    """
    if theta == 0.0:
        return 1.0, 0.0
    half = 0.5 * theta
    s = math.sin(half)
    return s * math.cos(half) / half, s * (s / half)  # s * s may underflow


@kernel
def _exp(twists: Array) -> Array:
    """Return the poses (n, 3) of twists (n, 3)."""
    out = np.empty_like(twists)
    for i in range(len(twists)):
        a, b = sinc_cosc(twists[i, 2])
        x, y = twists[i, 0], twists[i, 1]
        out[i, 0], out[i, 1] = a * x - b * y, b * x + a * y
        out[i, 2] = wrap_in_kernel(twists[i, 2])
    return out


@kernel
def _log(poses: Array) -> Array:
    """Return the twists (n, 3) of poses (n, 3)."""
    out = np.empty_like(poses)
    for i in range(len(poses)):
        theta = wrap_in_kernel(poses[i, 2])
        a, b = sinc_cosc(theta)
        scale, x, y = 1.0 / (a * a + b * b), poses[i, 0], poses[i, 1]
        out[i, 0], out[i, 1] = scale * (a * x + b * y), scale * (a * y - b * x)
        out[i, 2] = theta
    return out
