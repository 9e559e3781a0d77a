"""Normal equations of poses in blocks of three, solved by preconditioned conjugate gradients.

Rows are poses [x, y, theta] with additive errors. The chain of a drive contributes most constraints, so its
part, blocks (i, i) and (i, i + 1), is the preconditioner; it is factorised exactly (Saad 2003, Algorithm
9.1).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import invert, rotate_covariance
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

TOLERANCE, MAX_STEPS = 1e-3, 60
"""Relative residual at which a solution is accurate enough, since the next linearisation corrects the rest;
and maximum number of steps. A step propagates information to adjacent poses, so few steps do not change
what is constrained only over many poses; a thousand steps moved the shape of buildings by a decimetre,
without making their maps more accurate."""
_DAMPING = 1e-6  # makes rows of unconstrained poses invertible, and these poses stay


class BlockSystem(NamedTuple):
    """H x = -g for k poses.

    Attributes
    ----------
    diagonal : (k, 3, 3) blocks (i, i) of H
    off : (m, 3, 3) blocks (i, j) of H; several may be the same
    i, j : (m,) their row and column
    gradient : (k, 3) g
    fixed : (k,) poses that do not move: their rows of x are zero
    """

    diagonal: Array
    off: Array
    i: Ints
    j: Ints
    gradient: Array
    fixed: Mask


@kernel
def empty_system(i: Ints, j: Ints, fixed: Mask) -> BlockSystem:
    """Allocate the normal equations of poses, `fixed` (k,) or not, and of pairs i, j (m,) of them."""
    k, m = len(fixed), len(i)
    return BlockSystem(np.empty((k, 3, 3)), np.empty((m, 3, 3)), i, j, np.empty((k, 3)), fixed)


@kernel
def clear_system(system: BlockSystem) -> None:
    """Set H and g to zero, except ones on the diagonal of fixed poses."""
    system.diagonal[:], system.off[:], system.gradient[:] = 0.0, 0.0, 0.0
    for i in np.flatnonzero(system.fixed):
        for a in range(3):
            system.diagonal[i, a, a] = 1.0


@kernel
def add_relative(system: BlockSystem, row: int, poses: Array, H: Array, g: Array) -> None:
    """Add a constraint on pose j relative to pose i, which are those of off-diagonal block `row`.

    H (3, 3) and g (3,) are the normal equations of `between(poses[i], poses[j])`. That is
    B (x_j - K x_i) to first order, with B the rotation into frame i and K = [1 0 -dy; 0 1 dx; 0 0 1]; so H
    is rotated into the map's axes, and K^T propagates it to pose i. Fixed poses are left out.
    """
    i, j, fixed = system.i[row], system.j[row], system.fixed
    c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
    M = rotate_covariance(H, poses[i, 2])
    u, v = c * g[0] - s * g[1], s * g[0] + c * g[1]
    block = system.off[row]
    for a in range(3):
        block[0, a], block[1, a] = -M[0, a], -M[1, a]
        block[2, a] = -(dx * M[1, a] - dy * M[0, a] + M[2, a])  # rows of -K^T M
    if not fixed[i]:
        D, b = system.diagonal[i], system.gradient[i]
        for a in range(3):  # K^T M K
            D[a, 0] -= block[a, 0]
            D[a, 1] -= block[a, 1]
            D[a, 2] -= dx * block[a, 1] - dy * block[a, 0] + block[a, 2]
        b[0] -= u
        b[1] -= v
        b[2] -= dx * v - dy * u + g[2]
    if not fixed[j]:
        D, b = system.diagonal[j], system.gradient[j]
        for a in range(3):
            for k in range(3):
                D[a, k] += M[a, k]
        b[0] += u
        b[1] += v
        b[2] += g[2]
    if fixed[i] or fixed[j]:
        block[:] = 0.0


@kernel
def solve_system(system: BlockSystem, x: Array) -> int:
    """Fill x (k, 3) with the solution, zero for unconstrained poses; return the number of steps."""
    inverses, lower = _factorise(system)
    residual, z, product = -system.gradient, np.empty_like(x), np.empty_like(x)
    direction = np.zeros_like(x)
    x[:] = 0.0
    target, before = TOLERANCE * math.sqrt(_dot(residual, residual)), 1.0
    for step in range(MAX_STEPS):
        if not math.sqrt(_dot(residual, residual)) > target:
            return step
        _precondition(inverses, lower, residual, z)
        now = _dot(residual, z)
        _multiply_add(z, now / before if step else 0.0, direction)
        before = now
        _multiply(system, direction, product)
        curvature = _dot(direction, product)
        if not curvature > 0.0:
            return step
        length = now / curvature
        for i in range(len(x)):
            for a in range(3):
                x[i, a] += length * direction[i, a]
                residual[i, a] -= length * product[i, a]
    return MAX_STEPS


@kernel
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total


@kernel
def _multiply_add(z: Array, factor: float, out: Array) -> None:
    """Replace `out` by z + factor * out."""
    for i in range(len(z)):
        for a in range(3):
            out[i, a] = z[i, a] + factor * out[i, a]


@kernel
def _multiply(system: BlockSystem, x: Array, out: Array) -> None:
    """Fill `out` (k, 3) with H x."""
    for i in range(len(x)):
        D = system.diagonal[i]
        for a in range(3):
            out[i, a] = D[a, 0] * x[i, 0] + D[a, 1] * x[i, 1] + D[a, 2] * x[i, 2]
    for e in range(len(system.off)):
        i, j, B = system.i[e], system.j[e], system.off[e]
        for a in range(3):
            out[i, a] += B[a, 0] * x[j, 0] + B[a, 1] * x[j, 1] + B[a, 2] * x[j, 2]
            out[j, a] += B[0, a] * x[i, 0] + B[1, a] * x[i, 1] + B[2, a] * x[i, 2]


@kernel
def _factorise(system: BlockSystem) -> tuple[Array, Array]:
    """Return the chain's L D^-1 L^T: D^-1 (k, 3, 3), and L's blocks (i, i - 1) (k, 3, 3)."""
    k = len(system.diagonal)
    adjacent, inverses, lower = _adjacent(system), np.zeros((k, 3, 3)), np.zeros((k, 3, 3))
    M = np.empty((3, 3))
    for i in range(k):
        M[:] = system.diagonal[i]
        for a in range(3):
            M[a, a] += 1e-9 * M[a, a] + _DAMPING  # rounding must not make it indefinite
        for a in range(3 if i > 0 else 0):
            for b in range(3):
                for c in range(3):
                    lower[i, a, b] += adjacent[i, a, c] * inverses[i - 1, c, b]
            for b in range(3):
                for c in range(3):
                    M[a, b] -= lower[i, a, c] * adjacent[i, b, c]
        if invert(M):
            inverses[i] = M
    return inverses, lower


@kernel
def _adjacent(system: BlockSystem) -> Array:
    """Return the blocks (i, i - 1) of H, (k, 3, 3)."""
    out = np.zeros_like(system.diagonal)
    for e in range(len(system.off)):
        i, j = system.i[e], system.j[e]
        if abs(i - j) == 1:
            for a in range(3):
                for b in range(3):
                    out[max(i, j), a, b] += system.off[e, b, a] if j > i else system.off[e, a, b]
    return out


@kernel
def _precondition(inverses: Array, lower: Array, r: Array, z: Array) -> None:
    """Fill z (k, 3) with (L D L^T)^-1 r."""
    z[0] = r[0]
    for i in range(1, len(r)):
        L = lower[i]
        for a in range(3):
            z[i, a] = (
                r[i, a] - L[a, 0] * z[i - 1, 0] - L[a, 1] * z[i - 1, 1] - L[a, 2] * z[i - 1, 2]
            )
    for i in range(len(r) - 1, -1, -1):
        D, x, y, t = inverses[i], z[i, 0], z[i, 1], z[i, 2]
        for a in range(3):
            z[i, a] = D[a, 0] * x + D[a, 1] * y + D[a, 2] * t
        if i + 1 < len(r):
            L = lower[i + 1]
            for a in range(3):
                z[i, a] -= L[0, a] * z[i + 1, 0] + L[1, a] * z[i + 1, 1] + L[2, a] * z[i + 1, 2]
