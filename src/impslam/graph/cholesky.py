"""Sparse factors L D L^T of normal equations in blocks of three: exact solutions and covariances.

Each column is updated by those to its left that affect it (Davis 2006, section 4.8). L has unit blocks on
its diagonal. Covariances of all poses come from the selected inverse, i.e. the entries of the inverse where
L is not zero (Takahashi 1973; Kaess and Dellaert 2009).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import invert_into
from impslam.geometry.kernels import kernel
from impslam.graph.block_system import BlockSystem
from impslam.graph.elimination import Pattern
from impslam.types import Array


class Factor(NamedTuple):
    """The factorisation H = L D L^T, indexed by steps of the pattern.

    Attributes
    ----------
    pattern : the order of elimination, and the blocks of L
    lower : (m, 3, 3) blocks of L below its diagonal
    pivots, inverses : (k, 3, 3) blocks of D, and of its inverse
    """

    pattern: Pattern
    lower: Array
    pivots: Array
    inverses: Array


@kernel
def empty_factor(pattern: Pattern) -> Factor:
    """Allocate a factor."""
    k, m = len(pattern.step), len(pattern.rows)
    return Factor(pattern, np.empty((m, 3, 3)), np.empty((k, 3, 3)), np.empty((k, 3, 3)))


@kernel
def factorise(system: BlockSystem, damping: float, factor: Factor) -> int:
    """Fill the factor of H with its diagonal times 1 + damping; return the pose that fails, or -1.

    A pose fails if H is not positive definite there because the pose is not constrained.
    """
    pattern, lower, pivots = factor.pattern, factor.lower, factor.pivots
    _load(system, factor)
    k, poses = len(pattern.step), np.empty(len(pattern.step), np.int64)
    poses[pattern.step] = np.arange(k)
    place, M = np.empty(k, np.int64), np.empty((3, 3))
    for s in range(k):
        D = pivots[s]
        for a in range(3):
            D[a, a] *= 1.0 + damping
        scale = D[0, 0], D[1, 1], D[2, 2]
        for q in range(pattern.starts[s], pattern.starts[s + 1]):
            place[pattern.rows[q]] = q
        for t in range(pattern.row_starts[s], pattern.row_starts[s + 1]):
            c, q = pattern.columns[t], pattern.blocks[t]
            _times_transposed(pivots[c], lower[q], M)
            _subtract(lower[q], M, D)
            for r in range(q + 1, pattern.starts[c + 1]):
                _subtract(lower[r], M, lower[place[pattern.rows[r]]])
        if not invert_into(D, scale, factor.inverses[s]):
            return int(poses[s])
        for q in range(pattern.starts[s], pattern.starts[s + 1]):
            _times(lower[q], factor.inverses[s])
    return -1


@kernel
def _load(system: BlockSystem, factor: Factor) -> None:
    """Copy the blocks of H to those of D and L."""
    step, starts, rows = factor.pattern.step, factor.pattern.starts, factor.pattern.rows
    factor.lower[:] = 0.0
    for v in range(len(step)):
        factor.pivots[step[v]] = system.diagonal[v]
    for e in range(len(system.off)):
        i, j, B = system.i[e], system.j[e], system.off[e]
        if system.fixed[i] or system.fixed[j]:
            continue
        column, row = min(step[i], step[j]), max(step[i], step[j])
        low, high = starts[column], starts[column + 1] - 1
        while low < high:
            middle = (low + high) // 2
            if rows[middle] < row:
                low = middle + 1
            else:
                high = middle
        factor.lower[low] += B if step[i] == row else B.T


@kernel
def _times_transposed(A: Array, B: Array, out: Array) -> None:
    """Fill `out` with A B^T."""
    for a in range(3):
        for b in range(3):
            out[a, b] = A[a, 0] * B[b, 0] + A[a, 1] * B[b, 1] + A[a, 2] * B[b, 2]


@kernel
def _subtract(A: Array, M: Array, out: Array) -> None:
    """Subtract A M from `out`."""
    for a in range(3):
        x, y, z = A[a, 0], A[a, 1], A[a, 2]
        out[a, 0] -= x * M[0, 0] + y * M[1, 0] + z * M[2, 0]
        out[a, 1] -= x * M[0, 1] + y * M[1, 1] + z * M[2, 1]
        out[a, 2] -= x * M[0, 2] + y * M[1, 2] + z * M[2, 2]


@kernel
def _times(A: Array, M: Array) -> None:
    """Replace A by A M."""
    for a in range(3):
        x, y, z = A[a, 0], A[a, 1], A[a, 2]
        for b in range(3):
            A[a, b] = x * M[0, b] + y * M[1, b] + z * M[2, b]


@kernel
def substitute(factor: Factor, b: Array, x: Array) -> None:
    """Fill x (k, 3), by poses, with the solution of H x = b (k, 3)."""
    pattern, k = factor.pattern, len(b)
    y = np.empty_like(b)
    for v in range(k):
        y[pattern.step[v]] = b[v]
    for s in range(k):
        for q in range(pattern.starts[s], pattern.starts[s + 1]):
            L, r = factor.lower[q], pattern.rows[q]
            for a in range(3):
                y[r, a] -= L[a, 0] * y[s, 0] + L[a, 1] * y[s, 1] + L[a, 2] * y[s, 2]
    for s in range(k - 1, -1, -1):
        D, p, q, r = factor.inverses[s], y[s, 0], y[s, 1], y[s, 2]
        for a in range(3):
            y[s, a] = D[a, 0] * p + D[a, 1] * q + D[a, 2] * r
        for t in range(pattern.starts[s], pattern.starts[s + 1]):
            L, r = factor.lower[t], pattern.rows[t]
            for a in range(3):
                y[s, a] -= L[0, a] * y[r, 0] + L[1, a] * y[r, 1] + L[2, a] * y[r, 2]
    for v in range(k):
        x[v] = y[pattern.step[v]]


@kernel
def selected_inverse(factor: Factor) -> tuple[Array, Array]:
    """Return blocks of the inverse of H: (k, 3, 3) on the diagonal, by poses, and (m, 3, 3) as L's.

    Column s, from the last: Z_rs = -sum_t Z_rt L_ts and Z_ss = 1 / D_s - sum_t L_ts^T Z_ts, over the
    blocks t of column s. All required Z_rt are in the pattern.
    """
    pattern, lower = factor.pattern, factor.lower
    k, starts, rows = len(pattern.step), pattern.starts, pattern.rows
    diagonal, off = factor.inverses.copy(), np.zeros_like(lower)
    place = np.full(k, -1)
    for s in range(k - 1, -1, -1):
        for q in range(starts[s], starts[s + 1]):
            place[rows[q]] = q
        for q in range(starts[s], starts[s + 1]):
            t = rows[q]
            _subtract(diagonal[t], lower[q], off[q])
            for z in range(starts[t], starts[t + 1]):
                r = place[rows[z]]
                if r >= 0:
                    _subtract(off[z], lower[q], off[r])
                    _subtract_transposed(off[z], lower[r], off[q])
        for q in range(starts[s], starts[s + 1]):
            place[rows[q]] = -1
            _subtract_transposed(lower[q], off[q], diagonal[s])
    return diagonal[pattern.step], off


@kernel
def _subtract_transposed(A: Array, M: Array, out: Array) -> None:
    """Subtract A^T M from `out`."""
    for a in range(3):
        x, y, z = A[0, a], A[1, a], A[2, a]
        for b in range(3):
            out[a, b] -= x * M[0, b] + y * M[1, b] + z * M[2, b]
