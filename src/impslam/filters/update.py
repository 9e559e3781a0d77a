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

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

POSE = 3
_CHUNK = 128  # columns of the gain at a time, which a core's first cache holds


class Rows(NamedTuple):
    """The measurement Jacobian H of a scan by rows, see the module, and the innovations' noise.

    `noise` (rows, largest dim_z) are the rows of R's blocks, which begin at row `blocks` (rows,).
    `h_error` (rows,) measures the error that the sensor's observations share, which is number `errors`
    (rows,) of the q entries; -1: none.
    """

    slots: Ints
    blocks: Ints
    noise: Array
    h_pose: Array
    h_m: Array
    errors: Ints
    h_error: Array


@kernel
def among(P: Array, entries: Ints) -> Array:
    """Return P[entries][:, entries] (q, q) from the lower triangle."""
    q = len(entries)
    out = np.empty((q, q))
    for a in range(q):
        for b in range(a + 1):
            i, j = max(entries[a], entries[b]), min(entries[a], entries[b])
            out[a, b] = out[b, a] = P[i, j]
    return out


@kernel
def _rows_of(P: Array, entries: Ints, begin: int, end: int, out: Array) -> None:
    """Fill out (q, ...) with P[entries, begin:end] from the lower triangle."""
    for a in range(len(entries)):
        entry, row = entries[a], out[a]
        for i in range(begin, min(end, entry)):
            row[i - begin] = P[entry, i]
        for i in range(max(begin, entry), end):
            row[i - begin] = P[i, entry]


@kernel
def _measure(rows: Rows, P: Array, out: Array) -> None:
    """Fill out (rows, n) with H P for the q rows (q, >= n) of P."""
    slots, _, _, h_pose, h_m, errors, h_error = rows
    for r in range(len(slots)):
        measured, x, y, theta = out[r], P[0], P[1], P[2]
        for i in range(out.shape[1]):
            measured[i] = h_pose[r, 0] * x[i] + h_pose[r, 1] * y[i] + h_pose[r, 2] * theta[i]
        for c in range(h_m.shape[1]):
            if h_m[r, c] != 0.0:
                row = P[slots[r] + c]
                for i in range(out.shape[1]):
                    measured[i] += h_m[r, c] * row[i]
        if errors[r] >= 0:
            row = P[errors[r]]
            for i in range(out.shape[1]):
                measured[i] += h_error[r] * row[i]


@kernel
def _seen(rows: Rows, step: Array) -> Array:
    """Return H d (rows,) of a step d (q,); shared errors are considered, not moved."""
    slots, _, _, h_pose, h_m, _, _ = rows
    out = np.zeros(len(slots))
    for r in range(len(slots)):
        for c in range(POSE):
            out[r] += h_pose[r, c] * step[c]
        for c in range(h_m.shape[1]):
            if h_m[r, c] != 0.0:
                out[r] += h_m[r, c] * step[slots[r] + c]
    return out


@kernel
def innovation_covariance(rows: Rows, P: Array, entries: Ints) -> tuple[Array, Array]:
    """Return S = H P H^T + R (rows, rows) and H P (rows, q) for P among the q entries."""
    slots, blocks, noise, h_pose, h_m, errors, h_error = rows
    count, width = len(slots), h_m.shape[1]
    HP, S = np.empty((count, len(entries))), np.empty((count, count))
    _measure(rows, among(P, entries), HP)
    for a in range(count):
        for b in range(a + 1):
            total = noise[a, b - blocks[a]] if b >= blocks[a] else 0.0
            for c in range(POSE):
                total += h_pose[a, c] * HP[b, c]
            for c in range(width):
                if h_m[a, c] != 0.0:
                    total += h_m[a, c] * HP[b, slots[a] + c]
            if errors[a] >= 0:
                total += h_error[a] * HP[b, errors[a]]
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
    rows: Rows, P: Array, entries: Ints, innovation: Array, before: Array
) -> tuple[Array, Array, Array, float]:
    """Return U of S = U^T U, y = U^-T (nu + H d), the step (q,) = P H^T U^-1 y, and log det S.

    The latter is NaN where there is no U.

    d = `before` (q,) is the step at whose end H and nu were taken (Gauss-Newton); zero at first.
    """
    U, HP = innovation_covariance(rows, P, entries)
    y, step = innovation + _seen(rows, before), np.zeros(HP.shape[1])
    count = len(U)
    if not factorise(U):
        return U, y, step, np.nan
    log_det = 0.0
    for r in range(count):
        log_det += 2.0 * math.log(U[r, r])
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
    return U, y, step, log_det


@kernel
def gain(
    rows: Rows, P: Array, n: int, entries: Ints, U: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Return W^T = U^-T H P (rows, size), K nu = W y (size,) and P's rows of the pose (3, size).

    P - W W^T is the covariance after the correction. Columns from n on are zero; size is that of P.
    """
    count, size = len(U), len(P)
    W_T, step, of_pose = np.zeros((count, size)), np.zeros(size), np.zeros((POSE, size))
    of_seen, W = np.zeros((len(entries), _CHUNK)), np.empty((count, _CHUNK))
    for begin in range(0, n, _CHUNK):
        width = min(_CHUNK, n - begin)
        _rows_of(P, entries, begin, begin + width, of_seen)
        _measure(rows, of_seen, W)
        for r in range(count):
            row, moved = W[r], step[begin : begin + width]
            for b in range(r):
                above, u = W[b], U[b, r]
                for i in range(_CHUNK):
                    row[i] -= u * above[i]
            u = 1.0 / U[r, r]
            for i in range(_CHUNK):
                row[i] *= u
            for i in range(width):
                moved[i] += y[r] * row[i]
            W_T[r, begin : begin + width] = row[:width]
        for c in range(POSE):
            of_pose[c, begin : begin + width] = of_seen[c, :width]
    return W_T, step, of_pose
