"""A Gaussian belief over a pose and landmarks, stored for speed.

The mean is a vector, the covariance P the *lower triangle* of a preallocated Fortran-ordered array:
what bounds a large filter is the traffic of P through memory, and half of P is half the traffic. The
pose comes first. Everything here touches P in place and in order; nothing forms (I - K H) P.
"""

from __future__ import annotations

import numpy as np

from impslam.errors import NumericalError
from impslam.filters.blas import dpotrf, dsyrk, dtrsm, dtrsv
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

POSE = 3
_BLOCK = 64  # P grows in steps of this; more would be updated in vain at every scan


@kernel
def _gather(P: Array, o: int, block: Array) -> None:
    """Fill block with P of the pose and the landmark at offset o, full and symmetric."""
    size = len(block)
    for a in range(size):
        row = a if a < POSE else o + a - POSE
        for b in range(a + 1):
            column = b if b < POSE else o + b - POSE
            block[a, b] = block[b, a] = P[row, column]


@kernel
def _innovation_blocks(P: Array, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
    """Return H P H^T (k, dz, dz) of k landmarks, each measured alone."""
    k, dz, dm = z_D_m.shape
    size = POSE + dm
    out = np.empty((k, dz, dz))
    block, rows, half = np.empty((size, size)), np.empty((dz, size)), np.empty((dz, size))
    for i in range(k):
        _gather(P, offsets[i], block)
        rows[:, :POSE] = z_D_pose[i]
        rows[:, POSE:] = z_D_m[i]
        for a in range(dz):
            for p in range(size):
                half[a, p] = 0.0
                for q in range(size):
                    half[a, p] += block[p, q] * rows[a, q]
        for a in range(dz):
            for b in range(dz):
                out[i, a, b] = 0.0
                for p in range(size):
                    out[i, a, b] += rows[a, p] * half[b, p]
    return out


@kernel
def _cross(P: Array, n: int, offsets: Ints, dims: Ints, h_pose: Array, h_m: Array) -> Array:
    """Return (P H^T)^T (rows, len(P)): row r measures the pose and the landmark at offsets[r]."""
    rows = len(offsets)
    out = np.zeros((rows, len(P)))
    for r in range(rows):
        line = out[r]
        for c in range(POSE + dims[r]):
            column = c if c < POSE else offsets[r] + c - POSE
            h = h_pose[r, c] if c < POSE else h_m[r, c - POSE]
            if h == 0.0:
                continue
            for i in range(column):
                line[i] += h * P[column, i]
            for i in range(column, n):
                line[i] += h * P[i, column]
    return out


@kernel
def _measure(cross: Array, offsets: Ints, dims: Ints, h_pose: Array, h_m: Array) -> Array:
    """Return H (P H^T) (rows, rows), exactly symmetric."""
    rows = len(offsets)
    S = np.empty((rows, rows))
    for a in range(rows):
        for b in range(a + 1):
            total = 0.0
            for c in range(POSE):
                total += h_pose[a, c] * cross[b, c]
            for c in range(dims[a]):
                total += h_m[a, c] * cross[b, offsets[a] + c]
            S[a, b] = S[b, a] = total
    return S


@kernel
def _sandwich(P: Array, offsets: Ints, dims: Ints, h_pose: Array, h_m: Array) -> Array:
    """Return H P H^T (rows, rows) from the entries of P that H touches, whatever the size of P."""
    rows, size = len(offsets), POSE + h_m.shape[1]
    h, places = np.zeros((rows, size)), np.zeros((rows, size), np.int64)
    used = np.zeros(rows, np.int64)
    for a in range(rows):
        for c in range(POSE + dims[a]):
            value = h_pose[a, c] if c < POSE else h_m[a, c - POSE]
            if value != 0.0:
                h[a, used[a]] = value
                places[a, used[a]] = c if c < POSE else offsets[a] + c - POSE
                used[a] += 1
    out = np.empty((rows, rows))
    for a in range(rows):
        for b in range(a + 1):
            total = 0.0
            for c in range(used[a]):
                i = places[a, c]
                for d in range(used[b]):
                    j = places[b, d]
                    total += h[a, c] * h[b, d] * (P[i, j] if i >= j else P[j, i])
            out[a, b] = out[b, a] = total
    return out


@kernel
def _symmetric(P: Array, o: int, dim: int) -> Array:
    """Return P[o:o + dim, o:o + dim], full."""
    block = np.empty((dim, dim))
    for a in range(dim):
        for b in range(a + 1):
            block[a, b] = block[b, a] = P[o + a, o + b]
    return block


@kernel
def _compact(P: Array, indices: Ints) -> None:
    """Move the rows and columns at ascending indices to the front, in place."""
    for b in range(len(indices)):
        for a in range(b, len(indices)):
            P[a, b] = P[indices[a], indices[b]]


@kernel
def _rotate_pose(P: Array, n: int, fx: float, fy: float) -> None:
    """Apply F P F^T with F = I except F[0, 2] = fx and F[1, 2] = fy."""
    for i in range(POSE, n):
        P[i, 0] += fx * P[i, 2]
        P[i, 1] += fy * P[i, 2]
    tt, xt, yt = P[2, 2], P[2, 0], P[2, 1]
    P[0, 0] += 2.0 * fx * xt + fx * fx * tt
    P[1, 0] += fx * yt + fy * xt + fx * fy * tt
    P[1, 1] += 2.0 * fy * yt + fy * fy * tt
    P[2, 0] += fx * tt
    P[2, 1] += fy * tt


@kernel
def _put_rows(
    rows: tuple[Ints, Ints, Array, Array],
    starts: Ints,
    offsets: Ints,
    z_D_pose: Array,
    z_D_m: Array,
) -> None:
    (row_offsets, row_dims, h_pose, h_m), (k, dz, dim) = rows, z_D_m.shape
    for i in range(k):
        for a in range(dz):
            row = starts[i] + a
            row_offsets[row], row_dims[row] = offsets[i], dim
            for b in range(POSE):
                h_pose[row, b] = z_D_pose[i, a, b]
            for b in range(dim):
                h_m[row, b] = z_D_m[i, a, b]


@kernel
def put_blocks(vector: Array, matrix: Array, starts: Ints, parts: Array, blocks: Array) -> None:
    """Write parts (k, d) and, on the diagonal, blocks (k, d, d) to the rows from `starts` (k,) on."""
    for i in range(len(starts)):
        for a in range(parts.shape[1]):
            vector[starts[i] + a] = parts[i, a]
            for b in range(parts.shape[1]):
                matrix[starts[i] + a, starts[i] + b] = blocks[i, a, b]


class Rows:
    """The stacked sparse measurement Jacobian H of a scan: each row sees the pose and a landmark.

    offsets, dims : (rows,) where the landmark stands in the state, and its size
    h_pose, h_m : (rows, 3) and (rows, largest dim)
    """

    __slots__ = ("dims", "h_m", "h_pose", "offsets")

    def __init__(self, rows: int, largest: int) -> None:
        self.offsets = np.zeros(rows, np.int64)
        self.dims = np.zeros(rows, np.int64)
        self.h_pose = np.zeros((rows, POSE))
        self.h_m = np.zeros((rows, largest))

    def put(self, starts: Ints, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> None:
        """Enter measurements of k landmarks at some offsets, in the rows from `starts` (k,) on."""
        rows = self.offsets, self.dims, self.h_pose, self.h_m
        _put_rows(rows, starts, offsets, z_D_pose, z_D_m)

    def apply(self, delta: Array) -> Array:
        """Return H delta (rows,)."""
        columns = self.offsets[:, None] + np.arange(self.h_m.shape[1])
        landmarks = np.where(self.h_m != 0.0, delta[np.minimum(columns, len(delta) - 1)], 0.0)
        return np.asarray(self.h_pose @ delta[:POSE] + (self.h_m * landmarks).sum(axis=1))


class Gain:
    """The Kalman gain in square-root form: S = L L^T, W = P H^T L^-T, K = W L^-1."""

    __slots__ = ("L", "W", "n")

    def __init__(self, L: Array, W: Array, n: int) -> None:
        self.L, self.W, self.n = L, W, n

    def step(self, innovation: Array) -> Array:
        """Return K innovation (n,)."""
        return np.asarray((self.W @ dtrsv(self.L, innovation, lower=1))[: self.n])


class GaussianBelief:
    """Mean and covariance of [pose, landmark, landmark, ...]; knows sizes, not kinds."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        self.n = POSE
        self.mean = np.zeros(_BLOCK)
        self.P = np.zeros((_BLOCK, _BLOCK), order="F")
        self.mean[:POSE] = pose
        self.P[:POSE, :POSE] = covariance

    @property
    def covariance(self) -> Array:
        """P, full and symmetric (n, n); a copy."""
        return _symmetric(self.P, 0, self.n)

    def pose_covariance(self) -> Array:
        """Return the pose's (3, 3)."""
        return _symmetric(self.P, 0, POSE)

    def block(self, offset: int, dim: int) -> Array:
        """Return a landmark's own covariance (dim, dim)."""
        return _symmetric(self.P, offset, dim)

    def move(self, fx: float, fy: float, noise: Array) -> None:
        """Propagate P by F, the identity but for d(x, y)/d(theta) = (fx, fy), and add noise."""
        _rotate_pose(self.P, self.n, fx, fy)
        self.P[:POSE, :POSE] += noise

    def pose_entries(self) -> tuple[Array, Array]:
        """Return copies of all that `move` changes: the pose (3,) and P's first columns (n, 3)."""
        return self.mean[:POSE].copy(), self.P[: self.n, :POSE].copy()

    def restore(self, entries: tuple[Array, Array]) -> None:
        """Put back what `pose_entries` returned."""
        self.mean[:POSE], self.P[: self.n, :POSE] = entries

    def innovation_blocks(self, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
        """Return H P H^T (k, dz, dz) of k landmarks, each measured alone."""
        return _innovation_blocks(self.P, offsets, z_D_pose, z_D_m)

    def measured(self, rows: Rows) -> Array:
        """Return H P H^T (rows, rows) of measurements that need no correction yet."""
        return _sandwich(self.P, rows.offsets, rows.dims, rows.h_pose, rows.h_m)

    def gain(self, rows: Rows, R: Array) -> Gain:
        """Return the gain of a batch of measurements with noise R (rows, rows).

        Raises
        ------
        NumericalError
            If the innovations' covariance is not positive definite.
        """
        shape = rows.offsets, rows.dims, rows.h_pose, rows.h_m
        cross = _cross(self.P, self.n, *shape)
        L, info = dpotrf(_measure(cross, *shape) + R, lower=1, clean=1)
        if info or not np.isfinite(L).all():
            raise NumericalError(
                "the innovations' covariance is not positive definite: check the noise of the "
                "sensors and of the odometry (sigma, bias, ...)"
            )
        return Gain(L, dtrsm(1.0, L, cross.T, side=1, lower=1, trans_a=1, overwrite_b=1), self.n)

    def shrink(self, gain: Gain) -> None:
        """Correct P by the measurements behind a gain: P - W W^T, symmetric by construction."""
        self.P = dsyrk(-1.0, gain.W, beta=1.0, c=self.P, lower=1, overwrite_c=1)

    def extend(self, m: Array, m_D_pose: Array, noise: Array) -> int:
        """Append a landmark that depends on the pose and on noise (dim, dim); return its offset."""
        o, dim = self.n, len(m)
        self._reserve(o + dim)
        pose = self.pose_covariance()
        self.P[o : o + dim, :POSE] = m_D_pose @ pose
        self.P[o : o + dim, POSE:o] = m_D_pose @ self.P[POSE:o, :POSE].T
        self.P[o : o + dim, o : o + dim] = m_D_pose @ pose @ m_D_pose.T + noise
        self.mean[o : o + dim] = m
        self.n = o + dim
        return o

    def keep(self, indices: Ints) -> None:
        """Keep these entries of the state (sorted), forget the others."""
        self.n = len(indices)
        self.mean[: self.n] = self.mean[indices]
        _compact(self.P, indices)
        if len(self.mean) - self.n >= 2 * _BLOCK:
            self._resize(self.n)

    def _reserve(self, n: int) -> None:
        if n > len(self.mean):
            self._resize(n)

    def _resize(self, n: int) -> None:
        size = -(-n // _BLOCK) * _BLOCK
        mean, P = np.zeros(size), np.zeros((size, size), order="F")
        mean[: self.n] = self.mean[: self.n]
        P[: self.n, : self.n] = self.P[: self.n, : self.n]
        self.mean, self.P = mean, P
