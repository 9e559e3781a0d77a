"""All landmarks of a map of which a filter handles a few at a time, in columns by id."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.errors import ConfigError
from impslam.filters.atlas import Atlas, Table
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Ints, Landmark

_WIDEST = 4
"""Scalars of a landmark at most: 2 bits of their codes say which one it is."""


def codes_of(ids: Ints, dim: int) -> Ints:
    """Return by what codes (k, dim) the scalars of variables are known."""
    return (ids[:, None] << 2) + np.arange(dim)


class Archive:
    """What is known of landmarks beside the covariance, as it was when they were last handled.

    Landmarks are linear here: `shift` (n, dim) is the sum of the steps that their perturbations had made
    when they were at `state` (n, dim). A later shift puts them at `retract(state, later - shift)`.

    Attributes
    ----------
    kinds : (n,) numbers of the models, -1 for a landmark that was removed
    homes : (n,) the area each was first seen from, by its number
    places, sizes : (n, 2) where it was when its area was last brought up to date, m, and how far it extends
    """

    def __init__(self, models: Mapping[str, LandmarkModel]) -> None:
        self.names = list(models)
        for name, model in models.items():
            if model.dim > _WIDEST:
                raise ConfigError(
                    f"landmarks of kind {name!r} have {model.dim} scalars, and submaps take {_WIDEST} at "
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
        self.state: Array = np.empty((0, _WIDEST))
        self.shift: Array = np.empty((0, _WIDEST))
        self.places: Array = np.empty((0, 2))
        self.sizes: Array = np.empty(0)
        self._columns = [
            name for name, value in vars(self).items() if isinstance(value, np.ndarray)
        ]

    def enter(self, ids: Sequence[int], kinds: Sequence[str], area: int) -> None:
        """Make room for new landmarks of consecutive ids, first seen from an area."""
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
        """Keep the landmarks of a table, which stand at states (k, dim) after a shift (k, dim)."""
        ids, dim = table.ids, table.model.dim
        self.labels[ids], self.counts[ids] = table.labels, table.counts
        self.extents[ids], self.stamps[ids] = table.extents, table.stamps
        self.state[ids, :dim], self.shift[ids, :dim] = state, shift
        self.places[ids], self.sizes[ids] = state[:, :2], np.abs(table.extents).max(1, initial=0.0)

    def take(self, atlas: Atlas, kind: int, ids: Ints, offsets: Ints) -> Table:
        """Fill the table of a kind with landmarks that begin at these places of a state; return it."""
        table = atlas.table(self.names[kind])
        rows = self.labels[ids], self.extents[ids], self.counts[ids], self.stamps[ids]
        table.fill(ids, offsets, *rows)
        return table

    def states(self, ids: Ints, kind: int, shift: Array) -> Array:
        """Return where landmarks of one kind stand, (k, dim), after a shift (k, dim)."""
        model = self.model(kind)
        return model.retract(self.state[ids, : model.dim], shift - self.shift[ids, : model.dim])

    def by_kind(self, ids: Ints) -> list[tuple[int, Ints]]:
        """Return kinds with those of the landmarks that are of the kind; the removed ones are left out."""
        kinds = self.kinds[ids]
        found = ((kind, ids[kinds == kind]) for kind in range(len(self.names)))
        return [(kind, some) for kind, some in found if len(some)]

    def of_area(self, area: int) -> list[tuple[int, Ints]]:
        """Return `by_kind` of the landmarks first seen from an area."""
        return self.by_kind(np.flatnonzero(self.homes[: self.n] == area))

    def near(self, centre: Array, half: float, reach: float) -> Ints:
        """Return the ids of landmarks within reach of a square, and of those that exist once."""
        n = self.n
        apart = np.maximum(np.abs(self.places[:n] - centre) - half, 0.0)
        near = np.square(apart).sum(1) <= np.square(reach + self.sizes[:n])
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
        """Return the map in the form users read, by id.

        Given all shifts (n, dim) and by ids the covariances (dim, dim); `atlas` has the averages.
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
    """A mean, and each landmark's own covariance by where it begins in it."""

    mean: Array
    blocks: Mapping[int, Array]

    def block(self, offset: int, dim: int) -> Array:
        """Return a landmark's own covariance (dim, dim)."""
        del dim
        return self.blocks[offset]
