"""The landmarks of one kind of all particles: versions that particles share until one corrects its own.

A landmark of a particle is a row of a pool. A particle that survives twice is copied by its row numbers
(4 to 8 bytes a landmark); only who sees a landmark writes a new version of it, and a version that nobody
uses is written over. So a step costs what is seen in it, whatever the size of the map.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from impslam.estimators.particle_kernels import own
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Ints, Landmark, Mask

_POOL = 256  # rows; the pool grows by doubling


class Book:
    """The landmarks of a kind: L of them, in P particles.

    Attributes
    ----------
    rows : (P, L) version of each in the pool, -1 where a particle does not know it
    m, P, users : (r, dim), (r, dim, dim) and (r,) the pool: state, covariance, by how many it is used
    ids, labels, extents, counts, stamps : (L, ...) what particles have in common
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
        """Enter a landmark that some particles (h,) know, each in its own way (h, dim), (h, dim, dim)."""
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

    def own(self, particles: Ints, slots: Ints) -> Ints:
        """Return a version (n,) for each particle's landmark that it shares with none."""
        pairs = np.column_stack([particles, slots])
        shared = self.rows[particles, slots]
        free = self._free(len(pairs))
        versions = own(self.rows, self.users, free, pairs)
        moved = versions != shared
        self.m[versions[moved]], self.P[versions[moved]] = (
            self.m[shared[moved]],
            self.P[shared[moved]],
        )
        return versions

    def survive(self, parents: Ints) -> None:
        """Let particles be those that they were (P,); landmarks that none knows any more go."""
        self.rows = self.rows[parents]
        self._count()

    def forget(self, slots: Mask) -> None:
        """Strike landmarks (L,) out of all particles."""
        for number in self.ids[slots].tolist():
            del self.attributes[number]
        keep = ~slots
        self.rows = np.ascontiguousarray(self.rows[:, keep])
        for name in ("ids", "labels", "extents", "counts", "stamps"):
            setattr(self, name, getattr(self, name)[keep])
        self._count()

    def shares(self, weights: Array) -> Array:
        """Return the weight (L,) of those who know each landmark."""
        return weights @ (self.rows >= 0)

    def note(self, slot: int, stamp: float, attributes: Mapping[str, float]) -> None:
        """Count a sighting, and average what was measured beside z."""
        self.counts[slot] += 1
        self.stamps[slot, 1] = stamp
        average = self.attributes[int(self.ids[slot])]
        for name, value in attributes.items():
            old = average.get(name, value)
            average[name] = old + (value - old) / float(self.counts[slot])

    def landmark(self, slot: int, weights: Array) -> Landmark:
        """Return a landmark in the form users read: mean and covariance over those who know it.

        In the perturbation of the model, about the version of the likeliest; of every particle counts
        what it is unsure by, and how far it is from the mean.
        """
        holders = np.flatnonzero(self.rows[:, slot] >= 0)
        rows, w = self.rows[holders, slot], weights[holders]
        w = w / w.sum()
        best = self.m[rows[np.argmax(w)]]
        apart = self.model.difference(np.broadcast_to(best, (len(rows), len(best))), self.m[rows])
        mean = w @ apart
        m = self.model.retract(best[None], mean[None])[0]
        off = apart - mean
        P = np.einsum("h,hij->ij", w, self.P[rows]) + (w[:, None] * off).T @ off
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
