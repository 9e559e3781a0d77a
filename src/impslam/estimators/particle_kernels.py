"""Compiled loops of `particles` over P particles, each with its own landmarks."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

POSE = 3


@kernel
def _factorise(S: Array) -> bool:
    """Replace the lower triangle of S (n, n) by its Cholesky factor; return whether it has one."""
    for a in range(len(S)):
        for b in range(a + 1):
            total = S[a, b]
            for c in range(b):
                total -= S[a, c] * S[b, c]
            if a != b:
                S[a, b] = total / S[b, b]
            elif total > 0.0 and total < np.inf:
                S[a, a] = math.sqrt(total)
            else:
                return False
    return True


@kernel
def _solve_lower(L: Array, y: Array) -> None:
    """Replace y (n,) by L^-1 y."""
    for a in range(len(y)):
        for b in range(a):
            y[a] -= L[a, b] * y[b]
        y[a] /= L[a, a]


@kernel
def _add_product(out: Array, J: Array, P: Array) -> None:
    """Add J P J^T to out."""
    for a in range(len(out)):
        for b in range(len(out)):
            for c in range(len(P)):
                for d in range(len(P)):
                    out[a, b] += J[a, c] * P[c, d] * J[b, d]


@kernel
def axes(poses: Array, root: Array) -> Array:
    """Return (P, 3, 3): a root (3, 3) of a motion's covariance, rotated into map at each pose."""
    out = np.empty((len(poses), POSE, POSE))
    for p in range(len(poses)):
        c, s = math.cos(poses[p, 2]), math.sin(poses[p, 2])
        for j in range(POSE):
            out[p, 0, j] = c * root[0, j] - s * root[1, j]
            out[p, 1, j] = s * root[0, j] + c * root[1, j]
            out[p, 2, j] = root[2, j]
    return out


@kernel
def _innovation(z: Array, predicted: Array, angles: Mask, out: Array) -> None:
    """Fill out (dz,) with observation minus prediction, with angles wrapped."""
    for a in range(len(z)):
        value = z[a] - predicted[a]
        out[a] = wrap_in_kernel(value) if angles[a] else value


@kernel
def _may_fit(nu: Array, HPH: Array, R: Array, gate: float) -> bool:
    """Return whether nu may be in the gate: nu^T S^-1 nu is at least nu_a^2 / S_aa for every a."""
    may_fit = True
    for a in range(len(nu)):
        may_fit &= not nu[a] * nu[a] > gate * (HPH[a, a] + R[a, a])
    return may_fit


@kernel
def gated_pairs(
    predicted: tuple[Array, Array, Array],
    known: tuple[Ints, Array, Array],
    seen: tuple[Array, Array],
    possible: Mask,
    angles: Mask,
    gate: float,
) -> tuple[Ints, Array, Array, Array, Array]:
    """Return the pairs in the gate and their scores, in the order of particle, observation, landmark.

    Parameters
    ----------
    predicted : z (P, k, dz), z_D_pose (P, k, dz, 3), z_D_m (P, k, dz, dim)
    known : row (P, k) of each landmark in each particle, -1 for none; covariances (rows, dim, dim);
        roots (P, 3, 3) of the covariances of the poses
    seen : z (a, dz) and R (a, dz, dz)
    possible : (a, k) whether the extents allow each pair

    Returns
    -------
    pairs : (n, 3) particle, observation, landmark
    innovation, S, distance2, log_det : (n, dz), (n, dz, dz), (n,), (n,)
    """
    (z, R), (rows, P, roots) = seen, known
    (count, k, dz), observed = predicted[0].shape, len(z)
    HPH, near = np.zeros((count, k, dz, dz)), np.zeros((count, observed, k), np.bool_)
    nu = np.empty(dz)
    for p in range(count):
        for j in range(k):
            if rows[p, j] < 0:
                continue
            _add_product(HPH[p, j], predicted[2][p, j], P[rows[p, j]])
            _add_product(HPH[p, j], predicted[1][p, j] @ roots[p], np.eye(POSE))
            for i in range(observed):
                _innovation(z[i], predicted[0][p, j], angles, nu)
                near[p, i, j] = possible[i, j] and _may_fit(nu, HPH[p, j], R[i], gate)
    pairs = np.stack(near.nonzero(), axis=1)
    total = len(pairs)
    nus, S = np.empty((total, dz)), np.empty((total, dz, dz))
    distance2, log_det = np.full(total, np.inf), np.zeros(total)
    for n in range(total):
        p, i, j = pairs[n]
        _innovation(z[i], predicted[0][p, j], angles, nus[n])
        S[n] = HPH[p, j] + R[i]
        L, y = S[n].copy(), nus[n].copy()
        if _factorise(L):
            _solve_lower(L, y)
            distance2[n] = (y * y).sum()
            for a in range(dz):
                log_det[n] += 2.0 * math.log(L[a, a])
    inside = ~(distance2 > gate)
    return pairs[inside], nus[inside], S[inside], distance2[inside], log_det[inside]


@kernel
def add_information(
    particles: Ints,
    roots: Array,
    seen: tuple[Array, Array],
    jacobians: tuple[Array, Array],
    P: Array,
    out: tuple[Array, Array, Array],
) -> bool:
    """Add the information of matches on the poses: on u in pose + root u, with u ~ N(0, I) a priori.

    Parameters
    ----------
    particles : (n,) particle of each match
    roots : (P, 3, 3)
    seen : innovations (n, dz) and R (n, dz, dz)
    jacobians : z_D_pose (n, dz, 3) and z_D_m (n, dz, dim)
    P : (n, dim, dim) of the landmarks
    out : information (P, 3, 3) and vector (P, 3), and -2 log likelihood (P,) if u were 0

    Returns
    -------
    False if a covariance is not positive definite; `out` is then invalid.
    """
    (nu, R), (information, vector, cost) = seen, out
    dz = nu.shape[1]
    for n in range(len(particles)):
        p, Z = particles[n], R[n].copy()
        _add_product(Z, jacobians[1][n], P[n])
        if not _factorise(Z):
            return False
        y, A = nu[n].copy(), jacobians[0][n] @ roots[p]
        _solve_lower(Z, y)
        for c in range(POSE):
            column = A[:, c].copy()
            _solve_lower(Z, column)
            A[:, c] = column
        for a in range(dz):
            cost[p] += y[a] * y[a] + 2.0 * math.log(Z[a, a]) + math.log(2.0 * math.pi)
            for c in range(POSE):
                vector[p, c] += A[a, c] * y[a]
                for d in range(POSE):
                    information[p, c, d] += A[a, c] * A[a, d]
    return True


@kernel
def correct(nu: Array, R: Array, z_D_m: Array, P: Array) -> Array:
    """Correct P (n, dim, dim) of landmarks from known poses in place; return the steps (n, dim)."""
    n, dim = len(nu), P.shape[1]
    out = np.zeros((n, dim))
    for k in range(n):
        S = R[k].copy()
        _add_product(S, z_D_m[k], P[k])
        _factorise(S)
        y, W = nu[k].copy(), z_D_m[k] @ P[k]
        _solve_lower(S, y)
        for c in range(dim):
            column = W[:, c].copy()
            _solve_lower(S, column)
            W[:, c] = column
        for a in range(len(y)):
            for c in range(dim):
                out[k, c] += W[a, c] * y[a]
                for d in range(dim):
                    P[k, c, d] -= W[a, c] * W[a, d]
    return out


@kernel
def unshare(rows: Ints, users: Ints, free: Ints, pairs: Ints) -> Ints:
    """Give each (particle, landmark) of pairs (n, 2) an unshared version; return the versions (n,).

    A version with other users is replaced by one of `free` (at least n).
    """
    out, taken = np.empty(len(pairs), np.int64), 0
    for n in range(len(pairs)):
        row = rows[pairs[n, 0], pairs[n, 1]]
        if users[row] > 1:
            users[row] -= 1
            row = free[taken]
            taken += 1
            users[row] = 1
            rows[pairs[n, 0], pairs[n, 1]] = row
        out[n] = row
    return out


@kernel
def systematic(weights: Array, start: float) -> Ints:
    """Return the survivors (P,), ascending, by systematic resampling that starts at `start` / P."""
    count = len(weights)
    out, total, p = np.empty(count, np.int64), weights[0], 0
    for n in range(count):
        while total < (n + start) / count and p < count - 1:
            p += 1
            total += weights[p]
        out[n] = p
    return out
