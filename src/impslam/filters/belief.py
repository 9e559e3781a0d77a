"""A Gaussian belief over a pose and landmarks, stored for speed.

The mean is a vector, the covariance P the *lower triangle* of a preallocated Fortran-ordered array: the
speed of a large filter is limited by the memory traffic of P, which this halves. The pose comes first. All
operations access P in place and in order; none forms (I - K H) P.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from impslam.filters.blas import subtract_product, subtract_square
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.types import Array, Ints

POSE = 3
_PADDING = 8  # columns a power of two apart would compete for a few cache lines
_BLOCK = 64  # step by which P grows; a larger one would waste time at every scan


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
def innovation_blocks(P: Array, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
    """Return H P H^T (k, dz, dz) of k landmarks, each independently."""
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
def _symmetric(P: Array, o: int, dim: int) -> Array:
    """Return P[o:o + dim, o:o + dim], full."""
    block = np.empty((dim, dim))
    for a in range(dim):
        for b in range(a + 1):
            block[a, b] = block[b, a] = P[o + a, o + b]
    return block


@kernel
def rows_of(P: Array, entries: Ints, n: int) -> Array:
    """Return P[entries, :n] (k, n) from the lower triangle."""
    out = np.empty((len(entries), n))
    for a in range(len(entries)):
        entry = entries[a]
        for i in range(n):
            out[a, i] = P[entry, i] if i <= entry else P[i, entry]
    return out


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
def _drive(mean: Array, P: Array, n: int, d: Array, Q: Array) -> None:
    """Compose the pose with a motion d (3,) of covariance Q (3, 3): F P F^T + V Q V^T."""
    c, s = math.cos(mean[2]), math.sin(mean[2])
    _rotate_pose(P, n, -s * d[0] - c * d[1], c * d[0] - s * d[1])
    V, VQ = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros((POSE, POSE))
    for a in range(POSE):
        for b in range(POSE):
            for i in range(POSE):
                VQ[a, b] += V[a, i] * Q[i, b]
    for a in range(POSE):
        for b in range(a + 1):
            for i in range(POSE):
                P[a, b] += VQ[a, i] * V[b, i]
    mean[0] = mean[0] + c * d[0] - s * d[1]
    mean[1] = mean[1] + s * d[0] + c * d[1]
    mean[2] = wrap_in_kernel(mean[2] + d[2])


class HasBlocks(Protocol):
    """What is needed to report landmarks."""

    @property
    def mean(self) -> Array:
        """The state (n,)."""

    def block(self, offset: int, dim: int) -> Array:
        """Return a landmark's own covariance (dim, dim)."""


class Belief(Protocol):
    """Interface of a Gaussian over [pose, landmark, landmark, ...]."""

    n: int
    mean: Array
    errors: dict[str, int]
    """Indices in the state of the common errors of sensors and odometry, by name."""

    @property
    def covariance(self) -> Array:
        """P, full and symmetric (n, n); a copy."""

    def pose_covariance(self) -> Array:
        """Return the pose's (3, 3)."""

    def block(self, offset: int, dim: int) -> Array:
        """Return a landmark's own covariance (dim, dim)."""

    def innovation_blocks(self, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
        """Return H P H^T (k, dz, dz) of k landmarks, each independently."""

    def keep(self, indices: Ints) -> None:
        """Keep only these entries of the state (sorted)."""


class GaussianBelief:
    """Mean and covariance of [pose, landmark, landmark, ...], independent of kinds."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        self.n, self.errors, self._learned = POSE, dict[str, int](), set[str]()
        self.mean = np.zeros(_BLOCK + _PADDING)
        self.P = np.zeros((_BLOCK + _PADDING, _BLOCK + _PADDING), order="F")
        self.mean[:POSE] = pose
        self.P[:POSE, :POSE] = covariance

    @classmethod
    def of(cls, mean: Array, P: Array) -> GaussianBelief:
        """Return the belief with a mean (n,) and covariance (n, n)."""
        belief = cls(mean[:POSE], P[:POSE, :POSE])
        belief._reserve(len(mean))
        belief.n, belief.mean[: len(mean)] = len(mean), mean
        belief.P[: len(mean), : len(mean)] = P
        return belief

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
        """Propagate P by F, the identity except d(x, y)/d(theta) = (fx, fy), and add noise."""
        _rotate_pose(self.P, self.n, fx, fy)
        self.P[:POSE, :POSE] += noise

    def drive(self, d_pose: Array, covariance: Array) -> None:
        """Compose the pose with a motion (3,) of covariance (3, 3), to first order."""
        _drive(self.mean, self.P, self.n, plain(d_pose), plain(covariance))

    def renew(self, errors: Ints, correlation: Array) -> None:
        """Replace common errors at indices (k,) by ones that have a correlation (k,) with them."""
        for entry, kept in zip(errors.tolist(), correlation.tolist(), strict=True):
            self.mean[entry] *= kept
            self.P[entry, :entry] *= kept
            self.P[entry + 1 : self.n, entry] *= kept
            self.P[entry, entry] += (1.0 - kept**2) * (1.0 - self.P[entry, entry])

    def shift(self, errors: Ints, S: Array) -> None:
        """Add S e to the pose's error, S (3, k), for the common errors e at indices (k,)."""
        of_errors = rows_of(self.P, errors, self.n)
        C = S @ of_errors
        self.P[POSE : self.n, :POSE] += C[:, POSE:].T
        self.P[:POSE, :POSE] += np.tril(C[:, :POSE] + C[:, :POSE].T + C[:, errors] @ S.T)

    def moving_entries(self) -> tuple[Ints, Array, Array]:
        """Return what a motion changes: indices (k,) of pose and errors, their mean, P's rows (k, n)."""
        entries = np.array([*range(POSE), *self.errors.values()], np.int64)
        return entries, self.mean[entries], rows_of(self.P, entries, self.n)

    def restore(self, before: tuple[Ints, Array, Array]) -> None:
        """Restore the entries that `moving_entries` returned."""
        entries, self.mean[entries], rows = before
        for entry, row in zip(entries.tolist(), rows, strict=True):
            self.P[entry, :entry] = row[:entry]
            self.P[entry : self.n, entry] = row[entry:]

    def innovation_blocks(self, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
        """Return H P H^T (k, dz, dz) of k landmarks, each independently."""
        return innovation_blocks(self.P, offsets, z_D_pose, z_D_m)

    def subtract(self, left: Array, right: Array | None = None) -> None:
        """Subtract a symmetric product left^T right from P, both (k, n); left^T left without `right`.

        The variances of common errors do not change (Schmidt 1966), except of those that are learned.
        """
        if right is None:
            subtract_square(self.P, self.n, left)
        else:
            subtract_product(self.P, self.n, left, right)
        considered = [self.errors[name] for name in self.errors.keys() - self._learned]
        for row in considered:
            for column in considered:
                if column <= row:
                    self.P[row, column] = float(column == row)

    def extend(self, m: Array, m_D_pose: Array, noise: Array) -> int:
        """Append a landmark that depends on the pose and on noise (dim, dim); return its offset."""
        return self.append(m, np.arange(POSE), m_D_pose, noise)

    def append(self, m: Array, on: Ints, J: Array, noise: Array) -> int:
        """Append a landmark (dim,) that depends on entries (k,) by J (dim, k), and on noise (dim, dim)."""
        o, dim = self.n, len(m)
        self._reserve(o + dim)
        rows = J @ rows_of(self.P, on, o)
        self.P[o : o + dim, :o] = rows
        self.P[o : o + dim, o : o + dim] = rows[:, on] @ J.T + noise
        self.mean[o : o + dim] = m
        self.n = o + dim
        return o

    def error(self, name: str, *, learned: bool = False) -> int:
        """Return the index of a common error; add it with unit variance if it is new.

        One that is `learned` is estimated; the others are only considered.
        """
        if name not in self.errors:
            none = np.zeros((1, 0))
            self.errors[name] = self.append(np.zeros(1), np.arange(0), none, np.eye(1))
        if learned:
            self._learned.add(name)
        return self.errors[name]

    def learn(self, step: Array) -> None:
        """Move the means of the errors that are learned by a step (n,) of the whole state."""
        for name in self._learned:
            self.mean[self.errors[name]] += step[self.errors[name]]

    def keep(self, indices: Ints) -> None:
        """Keep only these entries of the state (sorted)."""
        self.n = len(indices)
        places = np.searchsorted(indices, list(self.errors.values())).tolist()
        self.errors = dict(zip(self.errors, places, strict=True))
        self.mean[: self.n] = self.mean[indices]
        _compact(self.P, indices)
        if len(self.mean) - self.n >= 2 * _BLOCK:
            self._resize(self.n)

    def _reserve(self, n: int) -> None:
        if n > len(self.mean):
            self._resize(n)

    def _resize(self, n: int) -> None:
        size = -(-n // _BLOCK) * _BLOCK + _PADDING
        mean, P = np.zeros(size), np.zeros((size, size), order="F")
        mean[: self.n] = self.mean[: self.n]
        P[: self.n, : self.n] = self.P[: self.n, : self.n]
        self.mean, self.P = mean, P
