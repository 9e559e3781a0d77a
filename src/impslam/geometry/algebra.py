"""Operations on poses [x, y, theta] and symmetric (3, 3) matrices for compiled loops, written out."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel

Array = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
_Factors: TypeAlias = tuple[bool, float, float, float, float, float, float]

SINGULAR = 1e-13
"""Minimum ratio of a pivot to its original diagonal: below, it is only rounding."""
_ZEROS = 0.0, 0.0, 0.0
_INDEFINITE: _Factors = False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


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
    """Replace b (3,) by x of A x = b; return False, without changes, unless A is positive definite."""
    is_definite, p, q, r, l10, l20, l21 = _factors(A, _ZEROS)
    if is_definite:
        b[1] -= l10 * b[0]
        b[2] -= l20 * b[0] + l21 * b[1]
        b[2] /= r
        b[1] = b[1] / q - l21 * b[2]
        b[0] = b[0] / p - l10 * b[1] - l20 * b[2]
    return bool(is_definite)


@kernel
def invert(A: Array) -> bool:
    """Replace A (3, 3) by its inverse; return False, without changes, unless it is positive definite."""
    return bool(invert_into(A, _ZEROS, A))


@kernel
def invert_into(A: Array, scale: tuple[float, float, float], out: Array) -> bool:
    """Fill `out` with the inverse of A (3, 3); return False, without changes, unless A is definite.

    `scale` are the diagonal entries from which A was computed by subtraction; see `SINGULAR`.
    """
    is_definite, p, q, r, l10, l20, l21 = _factors(A, scale)
    if is_definite:
        t = l10 * l21 - l20  # the last row of the inverse of L is [t, -l21, 1]
        out[2, 2] = 1.0 / r
        out[1, 2] = out[2, 1] = -l21 / r
        out[0, 2] = out[2, 0] = t / r
        out[1, 1] = 1.0 / q + l21 * l21 / r
        out[0, 1] = out[1, 0] = -l10 / q - l21 * t / r
        out[0, 0] = 1.0 / p + l10 * l10 / q + t * t / r
    return bool(is_definite)


@kernel
def _factors(A: Array, scale: tuple[float, float, float]) -> _Factors:
    """Return whether A = L D L^T is positive definite, p, q, r of D, and l10, l20, l21 of L."""
    p = A[0, 0]
    if not SINGULAR * scale[0] < p < math.inf:
        return _INDEFINITE
    l10, l20 = A[1, 0] / p, A[2, 0] / p
    q = A[1, 1] - l10 * A[1, 0]
    if not SINGULAR * scale[1] < q < math.inf:
        return _INDEFINITE
    l21 = (A[2, 1] - l10 * A[2, 0]) / q
    r = A[2, 2] - l20 * A[2, 0] - l21 * l21 * q
    if not SINGULAR * scale[2] < r < math.inf:
        return _INDEFINITE
    return True, p, q, r, l10, l20, l21
