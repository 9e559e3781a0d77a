"""Bookkeeping of a filter's landmarks: their offsets in the state, extents, counts and attributes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.errors import ConfigError
from impslam.filters.belief import HasBlocks
from impslam.filters.columns import NONE, ObservationColumns, ScanColumns, end_points
from impslam.landmarks.base import LandmarkModel, average
from impslam.types import Array, Ints, Landmark, Match, Observation


class Table:
    """The landmarks of one kind, in columns of length k; ids ascend."""

    def __init__(self, kind: str, model: LandmarkModel) -> None:
        self.kind, self.model = kind, model
        self.places: dict[int, int] = {}
        self.ids: Ints = np.empty(0, np.int64)
        self.labels: Ints = np.empty(0, np.int64)
        self.extents: Array = np.empty((0, 2))
        self.counts: Ints = np.empty(0, np.int64)
        self.stamps: Array = np.empty((0, 2))
        self.attributes: dict[int, dict[str, float]] = {}
        self.move(np.empty(0, np.int64))

    def move(self, offsets: Ints) -> None:
        """Set the offsets of the landmarks in the state; `columns` (k, dim) are all indices of each."""
        self.offsets: Ints = offsets
        self.columns: Ints = offsets[:, None] + np.arange(self.model.dim)

    def states(self, mean: Array, places: Ints | None = None) -> Array:
        """Return the states (k, dim) of all landmarks, or of those in some rows."""
        return mean[self.columns if places is None else self.columns.take(places, 0)]

    def append(self, row: tuple[int, int, int], extent: Array, stamp: float) -> None:
        """Add a landmark: (id, label, offset)."""
        self.places[row[0]] = len(self.ids)
        self.ids, self.labels, offsets = (
            np.append(column, value)
            for column, value in zip((self.ids, self.labels, self.offsets), row, strict=True)
        )
        self.move(offsets)
        self.extents = np.vstack([self.extents, extent])
        self.counts = np.append(self.counts, 1)
        self.stamps = np.vstack([self.stamps, [stamp, stamp]])

    def fill(
        self, ids: Ints, offsets: Ints, labels: Ints, extents: Array, counts: Ints, stamps: Array
    ) -> None:
        """Replace all landmarks by these L ones, ids ascending; averages of others are kept.

        All arguments have L rows; `extents` (L, 2) are in m, `stamps` (L, 2) in s, the first and the last.
        """
        self.places = {number: place for place, number in enumerate(ids.tolist())}
        self.ids, self.labels, self.extents = ids, labels, extents
        self.counts, self.stamps = counts, stamps
        self.move(offsets)

    def average(self, place: int, attributes: Mapping[str, float]) -> None:
        """Average attributes of an observation into those of a landmark, which counts it already."""
        average(self.attributes[int(self.ids[place])], attributes, 1.0 / float(self.counts[place]))

    def remove(self, places: list[int]) -> None:
        """Remove the landmarks in these rows."""
        for number in self.ids[places].tolist():
            del self.attributes[number]
        keep = np.ones(len(self.ids), np.bool_)
        keep[places] = False
        for name in ("ids", "labels", "extents", "counts", "stamps"):
            setattr(self, name, getattr(self, name)[keep])
        self.places = {number: place for place, number in enumerate(self.ids.tolist())}
        self.move(self.offsets[keep])


class LandmarkPairs(NamedTuple):
    """Matched landmarks of one kind and their observations.

    Attributes
    ----------
    table, places : the landmarks, and their rows in the table
    seen, rows : the observations of the kind, and the row of each landmark's observation
    which : indices of the matches
    """

    table: Table
    places: Ints
    seen: ObservationColumns
    rows: Ints
    which: list[int]


class Atlas:
    """All landmarks, one `Table` for each kind."""

    def __init__(self, models: Mapping[str, LandmarkModel]) -> None:
        self._models = models
        self._newest: tuple[Sequence[Observation], ScanColumns] = ((), ScanColumns(()))
        self._paired: tuple[Sequence[Match], list[LandmarkPairs]] = ((), [])
        self._tables: dict[str, Table] = {}
        self._next_id = 0

    def tables(self) -> list[Table]:
        """Return the tables that are not empty."""
        return [table for table in self._tables.values() if table.places]

    def ids(self) -> Ints:
        """Return the ids of all landmarks, ascending."""
        return np.sort(np.array([i for table in self.tables() for i in table.places], np.int64))

    def table(self, kind: str) -> Table:
        """Return the table of a kind."""
        if kind not in self._tables:
            if kind not in self._models:
                raise ConfigError(
                    f"no landmark model for observations of kind {kind!r}; register one"
                )
            self._tables[kind] = Table(kind, self._models[kind])
        return self._tables[kind]

    def columns(self, observations: Sequence[Observation]) -> ScanColumns:
        """Return observations as columns; those of the newest scan are cached."""
        known, columns = self._newest
        if observations is not known or not isinstance(known, tuple):
            columns = ScanColumns(observations)
            self._newest, self._paired = (observations, columns), ((), [])
        return columns

    def by_kind(
        self, observations: Sequence[Observation]
    ) -> Iterator[tuple[Table, ObservationColumns]]:
        """Yield the non-empty tables with the observations of their kinds."""
        for kind, columns in self.columns(observations).kinds.items():
            table = self.table(kind)
            if table.places:
                yield table, columns

    def pairs(
        self, observations: Sequence[Observation], matches: Sequence[Match]
    ) -> list[LandmarkPairs]:
        """Return the matched landmarks by kind; those of the newest scan are cached."""
        scan, (known, pairs) = self.columns(observations), self._paired
        if matches is not known or not isinstance(known, tuple):
            found = (self._pairs_in(table, scan, matches) for table in self._tables.values())
            pairs = [some for some in found if some.which]
            self._paired = matches, pairs
        return pairs

    def _pairs_in(self, table: Table, scan: ScanColumns, matches: Sequence[Match]) -> LandmarkPairs:
        known = table.places
        which = [i for i, match in enumerate(matches) if match.landmark in known]
        some = [matches[i] for i in which]
        places = np.array([known[match.landmark] for match in some], np.int64)
        rows = np.array([scan.rows[match.observation] for match in some], np.int64)
        return LandmarkPairs(table, places, scan.kinds.get(table.kind, NONE), rows, which)

    def add(
        self, pose: Array, observation: Observation, offset: int, m: Array, stamp: float
    ) -> int:
        """Add a landmark m (dim,), observed from a pose (3,), at an offset in the state; return its id."""
        table = self.table(observation.kind)
        number, self._next_id = self._next_id, self._next_id + 1
        self._paired = (), []
        extent = table.model.extents(pose, m[None], end_points([observation]))[0]
        label = -1 if observation.label is None else observation.label
        table.append((number, label, offset), extent, stamp)
        table.attributes[number] = {}
        average(table.attributes[number], observation.attributes, 1.0)
        return number

    def clear(self) -> None:
        """Remove all landmarks; averages are kept."""
        self._paired = (), []
        none = np.empty(0, np.int64)
        for table in self._tables.values():
            table.fill(none, none, none, np.empty((0, 2)), none, np.empty((0, 2)))

    def forget(self, ids: Sequence[int]) -> None:
        """Remove landmarks, but not their entries of the state."""
        gone, self._paired = set(ids), ((), [])
        for table in self._tables.values():
            removed = [k for k, number in enumerate(table.ids.tolist()) if number in gone]
            if removed:
                table.remove(removed)

    def remove(self, ids: Sequence[int], n: int) -> Ints:
        """Remove landmarks from a state of n scalars; return the remaining indices, sorted."""
        gone, self._paired = set(ids), ((), [])
        remaining = np.ones(n, np.bool_)
        for table in self._tables.values():
            removed = [k for k, number in enumerate(table.ids.tolist()) if number in gone]
            if removed:
                remaining[table.columns[removed]] = False
                table.remove(removed)
        position = np.cumsum(remaining) - 1
        for table in self._tables.values():
            table.move(position[table.offsets])
        return np.flatnonzero(remaining)

    def note(
        self,
        pose: Array,
        mean: Array,
        observations: Sequence[Observation],
        matches: Sequence[Match],
        stamp: float,
    ) -> None:
        """Update extents, counts, stamps and average attributes of matched landmarks."""
        for table, places, seen, rows, which in self.pairs(observations, matches):
            if table.model.has_extent:
                own = table.model.extents(pose, table.states(mean, places), seen.ends[rows])
                for place, (begin, end) in zip(places.tolist(), own.tolist(), strict=True):
                    known = table.extents[place]
                    known[0], known[1] = min(known[0], begin), max(known[1], end)
            for place, i in zip(places.tolist(), which, strict=True):
                table.counts[place] += 1
                table.stamps[place, 1] = stamp
                attributes = observations[matches[i].observation].attributes
                if attributes:
                    table.average(place, attributes)

    def of(self, ids: Sequence[int]) -> tuple[Table, Ints]:
        """Return the table of landmarks of one kind, and their rows in it."""
        table = next(table for table in self._tables.values() if ids[0] in table.places)
        return table, np.array([table.places[number] for number in ids])

    def join(self, mean: Array, kept: int, gone: int) -> None:
        """Merge extent, count, stamps, label and averages of landmark `gone` into those of `kept`."""
        table, (k, g) = self.of((kept, gone))
        states = table.states(mean, np.array([k, g]))
        ends = table.model.outline(states[1:], table.extents[[g]])
        begin, end = table.model.extents(np.zeros(3), states[:1], ends)[0]
        low, high = table.extents[k]
        table.extents[k] = min(low, begin), max(high, end)
        share = float(table.counts[g] / (table.counts[k] + table.counts[g]))
        table.counts[k] += table.counts[g]
        (first, last), (since, until) = table.stamps[k], table.stamps[g]
        table.stamps[k] = min(first, since), max(last, until)
        if table.labels[k] < 0:
            table.labels[k] = table.labels[g]
        average(table.attributes[kept], table.attributes[gone], share)

    def outlines(self, mean: Array) -> tuple[Ints, Array]:
        """Return the ids (k,) of visible landmarks and their ends (k, 2, 2) in map.

        A unique landmark, such as the frame of a GPS, is no object that a beam could hit.
        """
        tables = [table for table in self.tables() if not table.model.unique]
        if not tables:
            return np.empty(0, np.int64), np.empty((0, 2, 2))
        ends = [table.model.outline(table.states(mean), table.extents) for table in tables]
        return np.concatenate([table.ids for table in tables]), np.concatenate(ends)

    def in_values(self, mean: Array, A: Array) -> Array:
        """Return J A (2 k, m) for A (n, m): J is the derivative of all reported values, by id."""
        ids = self.ids()
        out = np.empty((len(ids), 2, A.shape[1]))
        for table in self.tables():
            reports = [table.model.report(m) for m in table.states(mean)]
            values_D_m = np.array([report.values_D_m for report in reports])
            out[np.searchsorted(ids, table.ids)] = values_D_m @ A[table.columns]
        return out.reshape(2 * len(ids), A.shape[1])

    def landmarks(self, belief: HasBlocks) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`, by id."""
        found = []
        for kind, table in self._tables.items():
            states = table.states(belief.mean)
            outlines = table.model.outline(states, table.extents)
            for k, number in enumerate(table.ids):
                report = table.model.report(states[k])
                P = belief.block(int(table.offsets[k]), table.model.dim)
                found.append(
                    Landmark(
                        int(number),
                        kind,
                        report.position,
                        {**report.values, **table.attributes[int(number)]},
                        report.values_D_m @ P @ report.values_D_m.T,
                        outlines[k] if table.extents[k, 1] > table.extents[k, 0] else None,
                        int(table.counts[k]),
                        float(table.stamps[k, 0]),
                        float(table.stamps[k, 1]),
                    )
                )
        return tuple(sorted(found, key=lambda landmark: landmark.id))
