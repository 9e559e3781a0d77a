"""A Gaussian belief over a pose and landmarks in square-root form.

P = S S^T, so P stays positive definite, and the state is x + S u with u of unit covariance: sigma points
are made of columns of S. S is lower triangular, with the pose's rows as heading, forward and left: only the
first column rotates the robot, and no column depends on the axes of the map.

All operations are orthogonal transformations of columns, in place and of quadratic cost (Kaminski, Bryson &
Schmidt 1971); a new landmark adds a few rows.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.filters.belief import POSE
from impslam.geometry.kernels import kernel
from impslam.geometry.roots import root
from impslam.types import Array, Ints


def _axes(theta: float) -> Array:
    """Return (3, 3), which maps a change [x, y, theta] to that of heading, forward and left."""
    c, s = math.cos(theta), math.sin(theta)
    return np.array([[0.0, 0.0, 1.0], [c, s, 0.0], [-s, c, 0.0]])


def _triangular(A: Array) -> Array:
    """Return the lower triangular L (n, n) of A A^T = L L^T with a non-negative diagonal; A (n, k)."""
    n = len(A)
    R = np.asarray(np.linalg.qr(A.T, mode="r"))
    L = np.zeros((n, n))
    L[:, : len(R)] = R.T
    return np.asarray(L * np.where(np.diag(L) < 0.0, -1.0, 1.0))


@kernel
def _add_square(S: Array, B: Array) -> None:
    """Replace S, lower triangular (n, n), by the root of S S^T + B B^T with B (k, n) as rows.

    Plane rotations of each column of S with the rows of B (Golub & Van Loan 2013, 6.5.4).
    """
    n = len(S)
    for j in range(n):
        for b in B:
            if b[j] == 0.0:
                continue
            length = math.hypot(S[j, j], b[j])
            c, s = S[j, j] / length, b[j] / length
            for i in range(j, n):
                old = S[i, j]
                S[i, j] = c * old + s * b[i]
                b[i] = c * b[i] - s * old


@kernel
def absorb(S: Array, n: int, H: Array, y: Array) -> Array:
    """Correct S, in place, by y (m,) = H u + noise of unit covariance; return the step (n,) S E[u].

    H (m, n) and y are overwritten. Scalars are processed one after the other, each in coordinates u that
    the previous ones have normalised to unit covariance: I - h h^T / (1 + h h^T) = T T^T with a triangular
    T, so S T is triangular, too (Carlson 1973). The outer loop is over columns.
    """
    m = len(y)
    c, sums = np.ones(m), np.zeros((m, n))  # 1 + h h^T and S h^T so far, over the columns passed
    by_others = np.zeros((m, m))  # the same for H h^T
    for j in range(n - 1, -1, -1):
        begin = 0 if j < POSE else j
        for r in range(m):
            v, total, row = H[r, j], c[r], sums[r]
            if v == 0.0:
                continue
            after = total + v * v
            keep, take = math.sqrt(total / after), v / math.sqrt(total * after)
            for i in range(begin, n):
                old = S[i, j]
                S[i, j] = keep * old - take * row[i]
                row[i] += v * old
            for i in range(r + 1, m):
                old = H[i, j]
                H[i, j] = keep * old - take * by_others[r, i]
                by_others[r, i] += v * old
            c[r] = after
    step = np.zeros(n)
    for r in range(m):
        weight = y[r] / c[r]
        for i in range(n):
            step[i] += weight * sums[r, i]
        for i in range(r + 1, m):
            y[i] -= weight * by_others[r, i]
    return step


@kernel
def own_roots(S: Array, offsets: Ints, dim: int) -> Array:
    """Return roots C (k, dim, dim) of the landmarks' covariances given the pose.

    C C^T = D D^T with D = S[m, 3:], the rows of the landmark at an offset.
    """
    out = np.zeros((len(offsets), dim, dim))
    for k, o in enumerate(offsets):
        C = out[k]
        for j in range(POSE, o + dim):
            for a in range(dim):
                for b in range(a + 1):
                    C[a, b] += S[o + a, j] * S[o + b, j]
        for a in range(dim):
            for b in range(a + 1):
                total = C[a, b]
                for p in range(b):
                    total -= C[a, p] * C[b, p]
                if a == b:
                    C[a, a] = math.sqrt(max(total, 0.0))
                else:
                    C[a, b] = total / C[b, b] if C[b, b] > 0.0 else 0.0
    return out


@kernel
def expand_columns(S: Array, offset: int, C: Array, h: Array, out: Array) -> None:
    """Fill out (dz, n) with the rows over u of a quantity with rows h (dz, 3 + dim) on pose and landmark.

    h is over the pose's three columns and over v of unit covariance: the landmark is S[m, :3] u + C v,
    hence v = C^-1 S[m, 3:] u.
    """
    dz, dim = len(h), len(C)
    v = np.empty(dim)
    out[:, :POSE] = h[:, :POSE]
    for j in range(POSE, offset + dim):
        for a in range(dim):
            total = S[offset + a, j]
            for b in range(a):
                total -= C[a, b] * v[b]
            v[a] = total / C[a, a] if C[a, a] > 0.0 else 0.0
        for r in range(dz):
            total = 0.0
            for a in range(dim):
                total += h[r, POSE + a] * v[a]
            out[r, j] = total


class SquareRootBelief:
    """Mean and root of the covariance of [pose, landmark, landmark, ...]."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        self.n, self.errors = POSE, dict[str, int]()
        self.mean = np.array(pose, np.float64)
        self._axes = _axes(float(pose[2]))
        self.S = np.asfortranarray(self._axes.T @ _triangular(self._axes @ root(covariance)))

    @property
    def covariance(self) -> Array:
        """P, full and symmetric (n, n)."""
        return np.asarray(self.S @ self.S.T)

    def pose_covariance(self) -> Array:
        """Return the pose's (3, 3)."""
        return np.asarray(self.S[:POSE, :POSE] @ self.S[:POSE, :POSE].T)

    def block(self, offset: int, dim: int) -> Array:
        """Return a landmark's own covariance (dim, dim)."""
        rows = self.S[offset : offset + dim]
        return np.asarray(rows @ rows.T)

    def innovation_blocks(self, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
        """Return H P H^T (k, dz, dz) of k landmarks, each independently."""
        entries = offsets[:, None] + np.arange(z_D_m.shape[2])
        rows = z_D_pose @ self.S[:POSE] + z_D_m @ self.S[entries]
        return np.asarray(rows @ rows.swapaxes(1, 2))

    def copy(self) -> SquareRootBelief:
        """Return an independent copy."""
        other = SquareRootBelief(self.mean[:POSE], np.zeros((POSE, POSE)))
        other.n, other.mean, other.S = self.n, self.mean.copy(), self.S.copy(order="F")
        other._axes = self._axes
        return other

    def drive(self, pose: Array, slopes: Array, noise: Array) -> None:
        """Move the pose to (3,), which depends on the first three columns by `slopes` (3, 3).

        `noise` (3, k) is a root of the covariance of its other dependencies.
        """
        self.mean[:POSE], self._axes = pose, _axes(float(pose[2]))
        both = np.column_stack([slopes, noise])
        Q, _ = np.linalg.qr((self._axes @ both).T, mode="complete")
        turned = both @ Q[:, :POSE]
        kept, lost = Q[:POSE, :POSE], _triangular(Q[:POSE, POSE:])
        by_pose = self.S[POSE:, :POSE].copy()
        self.S[:POSE, :POSE], self.S[POSE:, :POSE] = turned, by_pose @ kept
        _add_square(self.S[POSE:, POSE:], np.ascontiguousarray((by_pose @ lost).T))

    def absorb(self, H: Array, y: Array) -> Array:
        """Correct the covariance by y (m,) = H u + noise of unit covariance; return the mean's step."""
        return absorb(self.S, self.n, H, y)

    def extend(self, m: Array, slopes: Array, noise: Array) -> int:
        """Append a landmark; return its offset.

        It depends on the first three columns by `slopes` (dim, 3), and on noise (dim, dim).
        """
        o, dim = self.n, len(m)
        self.n = o + dim
        S = np.zeros((self.n, self.n), order="F")
        S[:o, :o] = self.S
        S[o:, :POSE], S[o:, o:] = slopes, np.linalg.cholesky(noise)
        self.mean, self.S = np.concatenate([self.mean, m]), S
        return o

    def keep(self, indices: Ints) -> None:
        """Keep only these entries of the state (sorted)."""
        rows = self.S[indices]
        rows[:POSE] = self._axes @ rows[:POSE]
        self.S = np.asfortranarray(_triangular(rows))
        self.S[:POSE] = self._axes.T @ self.S[:POSE]
        self.n, self.mean = len(indices), self.mean[indices]
