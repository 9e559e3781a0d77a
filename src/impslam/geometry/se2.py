"""Rigid motions of the plane.

A pose is `[x, y, theta]` (m, m, rad): the position and heading of a frame seen from another,
`T_a_b` being frame b in frame a. The manifold is R^2 x S^1 with the group law of SE(2). Closed forms
for `exp` and `log` follow Solà et al. 2018, "A micro Lie theory", Eq. 152-158; near theta = 0 they
switch to their Taylor series, where the closed forms lose their digits.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel

Array = npt.NDArray[np.float64]

_SMALL = 1e-4  # rad: the series below is exact to 1e-17 there, the closed form only to 1e-12


def rotation(theta: float) -> Array:
    """Return the 2x2 rotation matrix of an angle."""
    c, s = math.cos(theta), math.sin(theta)
    return np.array([[c, -s], [s, c]])


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """Return `T_a_c`, shape (3,)."""
    x, y, theta = T_a_b.tolist()  # plain floats: arithmetic on numpy's takes four times as long
    d_x, d_y, d_theta = T_b_c.tolist()
    c, s = math.cos(theta), math.sin(theta)
    return np.array([x + c * d_x - s * d_y, y + s * d_x + c * d_y, wrap(float(theta + d_theta))])


def compose_jacobians(T_a_b: Array, T_b_c: Array) -> tuple[Array, Array]:
    """Return the (3, 3) derivatives of `compose` by its first and its second argument."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    d_x, d_y, _ = T_b_c.tolist()
    first = np.array(
        [[1.0, 0.0, -s * d_x - c * d_y], [0.0, 1.0, c * d_x - s * d_y], [0.0, 0.0, 1.0]]
    )
    second = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return first, second


@kernel
def compose_uncertain(T_a_b: Array, P: Array, T_b_c: Array, Q: Array) -> tuple[Array, Array]:
    """Return `T_a_c` and its covariance (3, 3) to first order, from those P and Q of its parts."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    dx, dy = c * T_b_c[0] - s * T_b_c[1], s * T_b_c[0] + c * T_b_c[1]
    theta = math.pi - (math.pi - (T_a_b[2] + T_b_c[2])) % (2.0 * math.pi)  # wrapped
    first = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    second = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    out = np.zeros((3, 3))
    for J, C in ((first, P), (second, Q)):
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    for m in range(3):
                        out[i, j] += J[i, k] * C[k, m] * J[j, m]
    return np.array([T_a_b[0] + dx, T_a_b[1] + dy, theta]), out


def inverse(T_a_b: Array) -> Array:
    """Return `T_b_a`, shape (3,)."""
    x, y, theta = T_a_b.tolist()
    c, s = math.cos(theta), math.sin(theta)
    return np.array([-c * x - s * y, s * x - c * y, wrap(-float(theta))])


def between(T_a_b: Array, T_a_c: Array) -> Array:
    """Return `T_b_c`: frame c seen from frame b."""
    return compose(inverse(T_a_b), T_a_c)


def transform(T_a_b: Array, points_in_b: Array) -> Array:
    """Return points of shape (n, 2) given in frame b as points in frame a."""
    flat = np.ascontiguousarray(points_in_b, dtype=np.float64).reshape(-1, 2)
    return _transform(T_a_b, flat).reshape(np.shape(points_in_b))


@kernel
def _transform(T_a_b: Array, points: Array) -> Array:
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    out = np.empty((len(points), 2))
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        out[i, 0] = T_a_b[0] + c * x - s * y
        out[i, 1] = T_a_b[1] + s * x + c * y
    return out


def _sinc_cosc(theta: float) -> tuple[float, float]:
    """Return sin(t)/t and (1 - cos(t))/t, smooth through t = 0."""
    if abs(theta) < _SMALL:
        return 1.0 - theta * theta / 6.0, theta / 2.0 - theta**3 / 24.0
    return math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta


def exp(twist: Array) -> Array:
    """Return the pose reached by moving with a constant body twist `[vx, vy, omega]` for 1 s."""
    a, b = _sinc_cosc(float(twist[2]))
    return np.array(
        [a * twist[0] - b * twist[1], b * twist[0] + a * twist[1], wrap(float(twist[2]))]
    )


def log(pose: Array) -> Array:
    """Return the constant body twist that reaches the pose in 1 s; the inverse of `exp`."""
    theta = wrap(float(pose[2]))
    a, b = _sinc_cosc(theta)
    scale = 1.0 / (a * a + b * b)
    return np.array(
        [scale * (a * pose[0] + b * pose[1]), scale * (a * pose[1] - b * pose[0]), theta]
    )
