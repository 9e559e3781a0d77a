"""The landmarks of one kind in all particles: copy-on-write versions in a pool.

A landmark of a particle is a row of the pool. Resampling copies only row numbers (4 to 8 bytes a landmark);
a particle that observes a landmark writes a new version, and unused versions are overwritten. The cost of a
step thus depends on the number of observations, not on the size of the map.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from impslam.estimators.particle_kernels import unshare
from impslam.landmarks.base import LandmarkModel, average
from impslam.types import Array, Ints, Landmark, Mask

_POOL = 256  # rows; the pool grows by doubling


class LandmarkTable:
    """L landmarks of one kind in P particles.

    Attributes
    ----------
    rows : (P, L) row of each version in the pool, -1 if the particle does not have the landmark
    m, P, users : (r, dim), (r, dim, dim) and (r,) the pool: state, covariance, number of users
    ids, labels, extents, counts, stamps : (L, ...) common to all particles
    """

    def __init__(self, kind: str, model: LandmarkModel, particles: int) -> None:
        self.kind, self.model, dim = kind, model, model.dim
        self.rows: Ints = np.empty((particles, 0), np.int64)
        self.m, self.P = np.zeros((_POOL, dim)), np.zeros((_POOL, dim, dim))
        self.users: Ints = np.zeros(_POOL, np.int64)
        self.ids: Ints = np.empty(0, np.int64)
        self.labels: Ints = np.empty(0, np.int64)
        self.extents, self.stamps = np.empty((0, 2)), np.empty((0, 2))
        self.counts: Ints = np.empty(0, np.int64)
        self.attributes: dict[int, dict[str, float]] = {}

    def add(self, number: int, label: int, stamp: float, holders: Ints, m: Array, P: Array) -> None:
        """Add a landmark to the particles `holders` (h,), with their m (h, dim) and P (h, dim, dim)."""
        rows = self._free(len(holders))
        self.m[rows], self.P[rows], self.users[rows] = m, P, 1
        column = np.full(len(self.rows), -1)
        column[holders] = rows
        self.rows = np.column_stack([self.rows, column])
        self.ids, self.labels = np.append(self.ids, number), np.append(self.labels, label)
        self.extents = np.vstack([self.extents, [0.0, 0.0]])
        self.stamps = np.vstack([self.stamps, [stamp, stamp]])
        self.counts = np.append(self.counts, 1)
        self.attributes[number] = {}

    def unshare(self, particles: Ints, slots: Ints) -> Ints:
        """Return an unshared version (n,) of each particle's landmark, copied if necessary."""
        pairs = np.column_stack([particles, slots])
        shared = self.rows[particles, slots]
        free = self._free(len(pairs))
        versions = unshare(self.rows, self.users, free, pairs)
        copied = versions != shared
        self.m[versions[copied]] = self.m[shared[copied]]
        self.P[versions[copied]] = self.P[shared[copied]]
        return versions

    def resample(self, parents: Ints) -> None:
        """Replace the particles by their parents (P,), and free unused versions."""
        self.rows = self.rows[parents]
        self._count()

    def forget(self, slots: Mask) -> None:
        """Remove landmarks, given as a mask (L,), from all particles."""
        for number in self.ids[slots].tolist():
            del self.attributes[number]
        keep = ~slots
        self.rows = np.ascontiguousarray(self.rows[:, keep])
        for name in ("ids", "labels", "extents", "counts", "stamps"):
            setattr(self, name, getattr(self, name)[keep])
        self._count()

    def shares(self, weights: Array) -> Array:
        """Return the total weight (L,) of the particles that have each landmark."""
        return weights @ (self.rows >= 0)

    def note(self, slot: int, stamp: float, attributes: Mapping[str, float]) -> None:
        """Count an observation, and average its attributes."""
        self.counts[slot] += 1
        self.stamps[slot, 1] = stamp
        average(self.attributes[int(self.ids[slot])], attributes, 1.0 / float(self.counts[slot]))

    def landmark(self, slot: int, weights: Array) -> Landmark:
        """Return a landmark as `types.Landmark`: mean and covariance over its particles.

        They are computed in the perturbation of the model about the likeliest version; the covariance
        includes that of each particle and the spread of the means.
        """
        holders = np.flatnonzero(self.rows[:, slot] >= 0)
        rows, w = self.rows[holders, slot], weights[holders]
        w = w / w.sum()
        best = self.m[rows[np.argmax(w)]]
        offsets = self.model.difference(np.broadcast_to(best, (len(rows), len(best))), self.m[rows])
        mean = w @ offsets
        m = self.model.retract(best[None], mean[None])[0]
        residuals = offsets - mean
        P = np.einsum("h,hij->ij", w, self.P[rows]) + (w[:, None] * residuals).T @ residuals
        report, extent = self.model.report(m), self.extents[slot]
        number = int(self.ids[slot])
        return Landmark(
            number,
            self.kind,
            report.position,
            {**report.values, **self.attributes[number]},
            report.values_D_m @ P @ report.values_D_m.T,
            self.model.outline(m[None], extent[None])[0] if extent[1] > extent[0] else None,
            int(self.counts[slot]),
            float(self.stamps[slot, 0]),
            float(self.stamps[slot, 1]),
        )

    def _count(self) -> None:
        used = self.rows[self.rows >= 0]
        self.users = np.bincount(used, minlength=len(self.m))

    def _free(self, wanted: int) -> Ints:
        free = np.flatnonzero(self.users == 0)
        while len(free) < wanted:
            more = len(self.m)
            self.m = np.concatenate([self.m, np.zeros_like(self.m)])
            self.P = np.concatenate([self.P, np.zeros_like(self.P)])
            self.users = np.concatenate([self.users, np.zeros(more, np.int64)])
            free = np.flatnonzero(self.users == 0)
        return free[:wanted]
