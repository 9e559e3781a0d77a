"""Operations on poses [x, y, theta] and symmetric (3, 3) matrices for compiled loops, written out."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


@kernel
def between(T_a_b: Array, T_a_c: Array, T_b_c: Array) -> None:
    """Fill `T_b_c` (3,), frame c seen from frame b."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    x, y = T_a_c[0] - T_a_b[0], T_a_c[1] - T_a_b[1]
    T_b_c[0], T_b_c[1] = c * x + s * y, c * y - s * x
    T_b_c[2] = wrap_in_kernel(T_a_c[2] - T_a_b[2])


@kernel
def eigenvalues(xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Return the smaller and the larger eigenvalue of a symmetric (2, 2) matrix."""
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return mean - half, mean + half


@kernel
def rotate_covariance(C: Array, angle: float) -> Array:
    """Return a covariance (3, 3) of [x, y, theta] rotated by an angle in rad."""
    c, s = math.cos(angle), math.sin(angle)
    out = np.empty((3, 3))
    out[0, 0] = c * c * C[0, 0] - 2.0 * c * s * C[0, 1] + s * s * C[1, 1]
    out[1, 1] = s * s * C[0, 0] + 2.0 * c * s * C[0, 1] + c * c * C[1, 1]
    out[0, 1] = out[1, 0] = c * s * (C[0, 0] - C[1, 1]) + (c * c - s * s) * C[0, 1]
    out[0, 2] = out[2, 0] = c * C[0, 2] - s * C[1, 2]
    out[1, 2] = out[2, 1] = s * C[0, 2] + c * C[1, 2]
    out[2, 2] = C[2, 2]
    return out


@kernel
def solve(A: Array, b: Array) -> bool:
    """Replace b (3,) by x of A x = b; return False unless A (3, 3) is symmetric positive definite."""
    # A = L L^T by Cholesky, with only the entries below the diagonal of L and its inverse diagonal.
    p = A[0, 0]
    if not 0.0 < p < math.inf:
        return False
    p = 1.0 / math.sqrt(p)
    l10, l20 = A[1, 0] * p, A[2, 0] * p
    q = A[1, 1] - l10 * l10
    if not 0.0 < q < math.inf:
        return False
    q = 1.0 / math.sqrt(q)
    l21 = (A[2, 1] - l20 * l10) * q
    r = A[2, 2] - l20 * l20 - l21 * l21
    if not 0.0 < r < math.inf:
        return False
    y0 = b[0] * p
    y1 = (b[1] - l10 * y0) * q
    b[2] = (b[2] - l20 * y0 - l21 * y1) / r
    b[1] = (y1 - l21 * b[2]) * q
    b[0] = (y0 - l10 * b[1] - l20 * b[2]) * p
    return True


@kernel
def invert(A: Array) -> bool:
    """Replace A (3, 3) by its inverse; return False, without changes, unless it is positive definite."""
    inverse = np.eye(3)
    for k in range(3):
        if not solve(A, inverse[k]):
            return False
    for a in range(3):
        for b in range(3):
            A[a, b] = 0.5 * (inverse[a, b] + inverse[b, a])
    return True
