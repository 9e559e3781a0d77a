"""The arithmetic of a correction, on the few entries of the state that a scan sees.

The q entries are the pose and the matched landmarks, one landmark after another. H is given by rows:
`h_pose` (rows, 3) and `h_m` (rows, largest dim) measure the pose and the landmark whose first entry
is number `slots` (rows,) of the q. All that a linearisation needs is P among these entries; the
whole of P is read once when the correction is done.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.filters.blas import dtrsm
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

POSE = 3


class Rows(NamedTuple):
    """The measurement Jacobian H of a scan by rows, see the module, and the innovations' noise.

    `noise` (rows, largest dim_z) are the rows of R's blocks, which begin at row `blocks` (rows,).
    """

    slots: Ints
    blocks: Ints
    noise: Array
    h_pose: Array
    h_m: Array


@kernel
def _measured(rows: Rows, P: Array) -> Array:
    """Return H P (rows, q) for P (q, q) or the q rows (q, n) of P."""
    slots, _, _, h_pose, h_m = rows
    count, width, n = len(slots), h_m.shape[1], P.shape[1]
    out = np.zeros((count, n))
    for r in range(count):
        for c in range(POSE + width):
            h = h_pose[r, c] if c < POSE else h_m[r, c - POSE]
            if h != 0.0:
                row = P[c if c < POSE else slots[r] + c - POSE]
                for i in range(n):
                    out[r, i] += h * row[i]
    return out


@kernel
def _seen(rows: Rows, step: Array) -> Array:
    """Return H d (rows,) of a step d (q,)."""
    slots, _, _, h_pose, h_m = rows
    out = np.zeros(len(slots))
    for r in range(len(slots)):
        for c in range(POSE):
            out[r] += h_pose[r, c] * step[c]
        for c in range(h_m.shape[1]):
            if h_m[r, c] != 0.0:
                out[r] += h_m[r, c] * step[slots[r] + c]
    return out


@kernel
def innovation_covariance(rows: Rows, P: Array) -> tuple[Array, Array]:
    """Return S = H P H^T + R (rows, rows), its lower triangle, and H P (rows, q) for P (q, q)."""
    slots, blocks, noise, h_pose, h_m = rows
    count, width = len(slots), h_m.shape[1]
    HP, S = _measured(rows, P), np.empty((count, count))
    for a in range(count):
        for b in range(a + 1):
            total = noise[a, b - blocks[a]] if b >= blocks[a] else 0.0
            for c in range(POSE):
                total += h_pose[a, c] * HP[b, c]
            for c in range(width):
                if h_m[a, c] != 0.0:
                    total += h_m[a, c] * HP[b, slots[a] + c]
            S[a, b] = S[b, a] = total
    return S, HP


@kernel
def factorise(S: Array) -> bool:
    """Replace S by the factor U^T, lower triangular, of S = U^T U; tell whether it has one."""
    n = len(S)
    for j in range(n):
        if not S[j, j] > 0.0 or not S[j, j] < np.inf:
            return False
        root = math.sqrt(S[j, j])
        for i in range(j, n):
            S[j, i] /= root
        for k in range(j + 1, n):
            u = S[j, k]
            for i in range(k, n):
                S[k, i] -= u * S[j, i]
    return True


@kernel
def solve(
    rows: Rows, P: Array, innovation: Array, before: Array
) -> tuple[Array, Array, Array, bool]:
    """Return U of S = U^T U, y = U^-T (nu + H d), the step (q,) = P H^T U^-1 y, and if there is one.

    d = `before` (q,) is the step at whose end H and nu were taken (Gauss-Newton); zero at first.
    """
    U, HP = innovation_covariance(rows, P)
    y, step = innovation + _seen(rows, before), np.zeros(HP.shape[1])
    count = len(U)
    if not factorise(U):
        return U, y, step, False
    for r in range(count):
        y[r] /= U[r, r]
        for b in range(r + 1, count):
            y[b] -= U[r, b] * y[r]
    v = y.copy()
    for r in range(count - 1, -1, -1):
        for b in range(r + 1, count):
            v[r] -= U[r, b] * v[b]
        v[r] /= U[r, r]
        for i in range(len(step)):
            step[i] += v[r] * HP[r, i]
    return U, y, step, True


def gain(rows: Rows, P: Array, U: Array) -> Array:
    """Return W^T = U^-T H P (rows, n) for the q rows (q, n) of P.

    P - W W^T is the covariance after the correction, and K nu = W y.
    """
    cross = _measured(rows, P)
    W: Array = dtrsm(1.0, U.T, cross.T, side=1, lower=1, trans_a=1, overwrite_b=1)
    return W.T
