"""Compiled arithmetic of a correction, on the few entries of the state that a scan observes.

The q entries are the pose, the matched landmarks one after another, and the common errors of sensors. H
(rows, q) is the Jacobian by these; its many zeros are skipped. A linearisation only needs P of these
entries; the whole of P is read once at the end of the correction.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.filters.belief import POSE, rows_of
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask


@kernel
def put_rows(
    system: tuple[Array, Array, Array],
    at: tuple[int, int],
    seen: tuple[Array, Array],
    predicted: tuple[Array, Array, Array],
    angles: Mask,
) -> None:
    """Write the rows of k landmarks of a kind to H, R and nu, from a row and an entry on.

    `seen` are z (k, dz) and R (k, dz, dz); `predicted` are z, z_D_pose (k, dz, 3) and z_D_m (k, dz, dim).
    """
    (H, R, nu), (row, entry), (z, noise), (expected, z_D_pose, z_D_m) = system, at, seen, predicted
    k, dz, dim = z_D_m.shape
    for i in range(k):
        for a in range(dz):
            off = z[i, a] - expected[i, a]
            nu[row + a] = wrap_in_kernel(off) if angles[a] else off
            for b in range(dz):
                R[row + a, row + b] = noise[i, a, b]
            for c in range(POSE):
                H[row + a, c] = z_D_pose[i, a, c]
            for c in range(dim):
                H[row + a, entry + c] = z_D_m[i, a, c]
        row, entry = row + dz, entry + dim


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
def innovation_covariance(H: Array, P: Array, R: Array) -> Array:
    """Return S = H P H^T + R (rows, rows) for P (q, q) among the entries."""
    rows, q = H.shape
    HP, S = np.zeros((rows, q)), R.copy()
    for a in range(rows):
        for c in range(q):
            h = H[a, c]
            if h != 0.0:
                for i in range(q):
                    HP[a, i] += h * P[c, i]
    PH = HP.T.copy()  # to read it by rows
    for a in range(rows):
        for c in range(q):
            h = H[a, c]
            if h != 0.0:
                for b in range(a + 1):
                    S[a, b] += h * PH[c, b]
        for b in range(a):
            S[b, a] = S[a, b]
    return S


@kernel
def factorise(S: Array) -> bool:
    """Replace S (n, n) by the factor U of S = U^T U, in its upper triangle; return whether it has one."""
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
def _whiten(U: Array, G: Array, y: Array) -> None:
    """Replace the first rows of G (rows + 1, q) and y (rows,) by U^-T G and U^-T y, the last by y^T G."""
    rows, q = len(y), G.shape[1]
    for r in range(rows):
        y[r] /= U[r, r]
        for i in range(q):
            G[r, i] /= U[r, r]
            G[rows, i] += y[r] * G[r, i]
        for b in range(r + 1, rows):
            u = U[r, b]
            y[b] -= u * y[r]
            for i in range(q):
                G[b, i] -= u * G[r, i]


@kernel
def solve(
    system: tuple[Array, Array, Array], P: Array, entries: Ints, moving: int, before: Array
) -> tuple[Array, Array, tuple[float, float]]:
    """Return the correction by H, R and nu, with S = U^T U, and nu^T S^-1 nu and log det S.

    The first result is G = U^-T H (rows, q) with g = (U^-T nu)^T G as last row: the mean moves by g P, and
    P becomes P - (G P)^T G P. The second is the step (q,) of the entries, zero after the first `moving`
    ones. If there is no U, log det S is NaN.

    `before` (q,) is the step after which H and nu were evaluated (Gauss-Newton), at first zero.
    """
    H, R, nu = system
    (rows, q), P_seen, y = H.shape, among(P, entries), nu.copy()
    G, step = np.zeros((rows + 1, q)), np.zeros(q)
    for r in range(rows):
        for c in range(q):
            G[r, c] = H[r, c]
            y[r] += H[r, c] * before[c]
    U = innovation_covariance(H, P_seen, R)
    if not factorise(U):
        return G, step, (np.nan, np.nan)
    _whiten(U, G, y)
    nis, log_det = 0.0, 0.0
    for r in range(rows):
        nis, log_det = nis + y[r] * y[r], log_det + 2.0 * math.log(U[r, r])
    for c in range(q):
        for i in range(moving):
            step[i] += G[rows, c] * P_seen[c, i]
    return G, step, (nis, log_det)


@kernel
def gain(P: Array, n: int, entries: Ints, G: Array) -> tuple[Array, Array, Array]:
    """Return W^T = G P (rows, n), the step g P (n,) and P's rows of the pose (3, n).

    P - W W^T is the covariance after the correction.
    """
    P_rows = rows_of(P, entries, n)
    W_T = G @ P_rows
    return W_T[:-1], W_T[-1], P_rows[:POSE]
