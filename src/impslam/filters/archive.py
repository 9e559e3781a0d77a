"""Column storage by id of all landmarks of a map, for filters that handle only a few at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.errors import ConfigError
from impslam.filters.atlas import Atlas, Table
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Ints, Landmark

_MAX_DIM = 4
"""Scalars of a landmark; 2 bits of a code are the index of the scalar."""


def codes_of(ids: Ints, dim: int) -> Ints:
    """Return the codes (k, dim) of the scalars of variables."""
    return (ids[:, None] << 2) + np.arange(dim)


class Archive:
    """The state of landmarks without covariances, as of when they were last handled.

    Landmarks are linear here: `shift` (n, dim) is the sum of the steps of their perturbations up to `state`
    (n, dim). After a later shift they are at `retract(state, later - shift)`.

    Attributes
    ----------
    kinds : (n,) numbers of the models, -1 for a removed landmark
    homes : (n,) number of the area from which each was first seen
    places, sizes : (n, 2) and (n,) m, position at the last update of its area, and extent
    """

    def __init__(self, models: Mapping[str, LandmarkModel]) -> None:
        self.names = list(models)
        for name, model in models.items():
            if model.dim > _MAX_DIM:
                raise ConfigError(
                    f"landmarks of kind {name!r} have {model.dim} scalars, and submaps take {_MAX_DIM} at "
                    "most; choose another filter, for instance filter.kind=ekf"
                )
        self._models = models
        self.n = 0
        self.kinds: Ints = np.empty(0, np.int64)
        self.homes: Ints = np.empty(0, np.int64)
        self.labels: Ints = np.empty(0, np.int64)
        self.counts: Ints = np.empty(0, np.int64)
        self.extents: Array = np.empty((0, 2))
        self.stamps: Array = np.empty((0, 2))
        self.state: Array = np.empty((0, _MAX_DIM))
        self.shift: Array = np.empty((0, _MAX_DIM))
        self.places: Array = np.empty((0, 2))
        self.sizes: Array = np.empty(0)
        self._columns = [
            name for name, value in vars(self).items() if isinstance(value, np.ndarray)
        ]

    def add(self, ids: Sequence[int], kinds: Sequence[str], area: int) -> None:
        """Add new landmarks with consecutive ids, first seen from an area."""
        self.n += len(ids)
        if self.n > len(self.kinds):
            for name in self._columns:
                old = getattr(self, name)
                new = np.zeros((2 * self.n + 64, *old.shape[1:]), old.dtype)
                new[: len(old)] = old
                setattr(self, name, new)
        self.kinds[list(ids)] = [self.names.index(kind) for kind in kinds]
        self.homes[list(ids)], self.labels[list(ids)] = area, -1

    @property
    def size(self) -> int:
        """Number of scalars of all landmarks."""
        kinds = self.kinds[: self.n]
        return sum(self.model(k).dim * int((kinds == k).sum()) for k in range(len(self.names)))

    def model(self, kind: int) -> LandmarkModel:
        """Return the model by its number."""
        return self._models[self.names[kind]]

    def put(self, table: Table, state: Array, shift: Array) -> None:
        """Store the landmarks of a table, with states (k, dim) after a shift (k, dim)."""
        ids, dim = table.ids, table.model.dim
        self.labels[ids], self.counts[ids] = table.labels, table.counts
        self.extents[ids], self.stamps[ids] = table.extents, table.stamps
        self.state[ids, :dim], self.shift[ids, :dim] = state, shift
        self.places[ids], self.sizes[ids] = state[:, :2], np.abs(table.extents).max(1, initial=0.0)

    def take(self, atlas: Atlas, kind: int, ids: Ints, offsets: Ints) -> Table:
        """Fill the table of a kind with landmarks at these offsets of a state; return the table."""
        table = atlas.table(self.names[kind])
        rows = self.labels[ids], self.extents[ids], self.counts[ids], self.stamps[ids]
        table.fill(ids, offsets, *rows)
        return table

    def states(self, ids: Ints, kind: int, shift: Array) -> Array:
        """Return the states (k, dim) of landmarks of one kind after a shift (k, dim)."""
        model = self.model(kind)
        return model.retract(self.state[ids, : model.dim], shift - self.shift[ids, : model.dim])

    def by_kind(self, ids: Ints) -> list[tuple[int, Ints]]:
        """Return the landmarks by kind, without removed ones."""
        kinds = self.kinds[ids]
        found = ((kind, ids[kinds == kind]) for kind in range(len(self.names)))
        return [(kind, some) for kind, some in found if len(some)]

    def of_area(self, area: int) -> list[tuple[int, Ints]]:
        """Return `by_kind` of the landmarks first seen from an area."""
        return self.by_kind(np.flatnonzero(self.homes[: self.n] == area))

    def near(self, centre: Array, half: float, distance: float) -> Ints:
        """Return the ids of landmarks within a distance of a square, and of those of unique kinds."""
        n = self.n
        outside = np.maximum(np.abs(self.places[:n] - centre) - half, 0.0)
        near = np.square(outside).sum(1) <= np.square(distance + self.sizes[:n])
        for kind, name in enumerate(self.names):
            if self._models[name].unique:
                near |= self.kinds[:n] == kind
        return np.flatnonzero(near & (self.kinds[:n] >= 0))

    def labelled(self, kind: str, labels: list[int]) -> Ints:
        """Return the ids of the landmarks of a kind with one of these labels."""
        n = self.n
        of_kind = self.kinds[:n] == self.names.index(kind)
        return np.flatnonzero(of_kind & np.isin(self.labels[:n], labels))

    def report(
        self, atlas: Atlas, shift: Array, blocks: Mapping[int, Array]
    ) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`, by id.

        `shift` (n, dim) are the shifts of all, `blocks` the covariances (dim, dim) by id; `atlas` has the
        averages.
        """
        whole, begin, means, by_offset = Atlas(self._models), 0, [np.empty(0)], dict[int, Array]()
        for kind, ids in self.by_kind(np.arange(self.n)):
            dim = self.model(kind).dim
            offsets = begin + dim * np.arange(len(ids))
            table = self.take(whole, kind, ids, offsets)
            table.attributes = atlas.table(table.kind).attributes
            means.append(self.states(ids, kind, shift[ids, :dim]).ravel())
            by_offset |= zip(offsets.tolist(), map(blocks.__getitem__, ids.tolist()), strict=True)
            begin += dim * len(ids)
        return whole.landmarks(_Blocks(np.concatenate(means), by_offset))


class _Blocks(NamedTuple):
    """A mean, and each landmark's own covariance by its offset in it."""

    mean: Array
    blocks: Mapping[int, Array]

    def block(self, offset: int, dim: int) -> Array:
        """Return a landmark's own covariance (dim, dim)."""
        del dim
        return self.blocks[offset]
