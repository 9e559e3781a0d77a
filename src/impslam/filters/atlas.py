"""The books of a filter's landmarks: which stands where in the state, and its life story."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.errors import ConfigError
from impslam.filters.belief import HasBlocks
from impslam.filters.columns import NONE, Columns, ScanColumns, end_points
from impslam.landmarks.base import LandmarkModel
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
        """Say where in the state each landmark begins; `columns` (k, dim) are all its indices."""
        self.offsets: Ints = offsets
        self.columns: Ints = offsets[:, None] + np.arange(self.model.dim)

    def states(self, mean: Array, places: Ints | None = None) -> Array:
        """Return the states (k, dim) of all landmarks, or of those at some places."""
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
        """Hold these landmarks, ids ascending, and no others; averages of others are kept."""
        self.places = {number: place for place, number in enumerate(ids.tolist())}
        self.ids, self.labels, self.extents = ids, labels, extents
        self.counts, self.stamps = counts, stamps
        self.move(offsets)

    def average(self, place: int, attributes: Mapping[str, float]) -> None:
        """Take what was measured beside z into a landmark's averages; it is counted already."""
        average = self.attributes[int(self.ids[place])]
        for name, value in attributes.items():
            old = average.get(name, value)
            average[name] = old + (value - old) / float(self.counts[place])

    def strike(self, places: list[int]) -> None:
        """Forget the landmarks at these places."""
        for number in self.ids[places].tolist():
            del self.attributes[number]
        keep = np.ones(len(self.ids), np.bool_)
        keep[places] = False
        for name in ("ids", "labels", "extents", "counts", "stamps"):
            setattr(self, name, getattr(self, name)[keep])
        self.places = {number: place for place, number in enumerate(self.ids.tolist())}
        self.move(self.offsets[keep])


class Pairs(NamedTuple):
    """Matched landmarks of one kind and what is seen of them.

    Attributes
    ----------
    table, places : the landmarks and where they stand in it
    seen, rows : the observations of the kind, and which of them was matched with which landmark
    which : indices of the matches
    """

    table: Table
    places: Ints
    seen: Columns
    rows: Ints
    which: list[int]


class Atlas:
    """All landmarks, one `Table` for each kind."""

    def __init__(self, models: Mapping[str, LandmarkModel]) -> None:
        self._models = models
        self._newest: tuple[Sequence[Observation], ScanColumns] = ((), ScanColumns(()))
        self._paired: tuple[Sequence[Match], list[Pairs]] = ((), [])
        self._tables: dict[str, Table] = {}
        self._next_id = 0

    def tables(self) -> list[Table]:
        """Return the tables that hold landmarks."""
        return [table for table in self._tables.values() if table.places]

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
        """Return observations as columns; those of the newest scan are kept."""
        known, columns = self._newest
        if observations is not known or not isinstance(known, tuple):
            columns = ScanColumns(observations)
            self._newest, self._paired = (observations, columns), ((), [])
        return columns

    def by_kind(self, observations: Sequence[Observation]) -> Iterator[tuple[Table, Columns]]:
        """Yield each kind's table, where it has landmarks, with the observations of the kind."""
        for kind, columns in self.columns(observations).kinds.items():
            table = self.table(kind)
            if table.places:
                yield table, columns

    def pairs(self, observations: Sequence[Observation], matches: Sequence[Match]) -> list[Pairs]:
        """Return kind by kind the landmarks that are matched; those of the newest scan are kept."""
        scan, (known, pairs) = self.columns(observations), self._paired
        if matches is not known or not isinstance(known, tuple):
            found = (self._pairs_in(table, scan, matches) for table in self._tables.values())
            pairs = [some for some in found if some.which]
            self._paired = matches, pairs
        return pairs

    def _pairs_in(self, table: Table, scan: ScanColumns, matches: Sequence[Match]) -> Pairs:
        known = table.places
        which = [i for i, match in enumerate(matches) if match.landmark in known]
        some = [matches[i] for i in which]
        places = np.array([known[match.landmark] for match in some], np.int64)
        rows = np.array([scan.rows[match.observation] for match in some], np.int64)
        return Pairs(table, places, scan.kinds.get(table.kind, NONE), rows, which)

    def add(
        self, pose: Array, observation: Observation, offset: int, m: Array, stamp: float
    ) -> int:
        """Enter a new landmark; return its id."""
        table = self.table(observation.kind)
        number, self._next_id = self._next_id, self._next_id + 1
        self._paired = (), []
        extent = table.model.extents(pose, m[None], end_points([observation]))[0]
        label = -1 if observation.label is None else observation.label
        table.append((number, label, offset), extent, stamp)
        table.attributes[number] = dict(observation.attributes)
        return number

    def clear(self) -> None:
        """Hold no landmark; averages are kept."""
        self._paired = (), []
        none = np.empty(0, np.int64)
        for table in self._tables.values():
            table.fill(none, none, none, np.empty((0, 2)), none, np.empty((0, 2)))

    def forget(self, ids: Sequence[int]) -> None:
        """Strike landmarks out; the state keeps their entries."""
        gone, self._paired = set(ids), ((), [])
        for table in self._tables.values():
            leaving = [k for k, number in enumerate(table.ids.tolist()) if number in gone]
            if leaving:
                table.strike(leaving)

    def remove(self, ids: Sequence[int], n: int) -> Ints:
        """Strike landmarks out of a state of n scalars; return the indices that stay, sorted."""
        gone, self._paired = set(ids), ((), [])
        stays = np.ones(n, np.bool_)
        for table in self._tables.values():
            leaving = [k for k, number in enumerate(table.ids.tolist()) if number in gone]
            if leaving:
                stays[table.columns[leaving]] = False
                table.strike(leaving)
        position = np.cumsum(stays) - 1
        for table in self._tables.values():
            table.move(position[table.offsets])
        return np.flatnonzero(stays)

    def note(
        self,
        pose: Array,
        mean: Array,
        observations: Sequence[Observation],
        matches: Sequence[Match],
        stamp: float,
    ) -> None:
        """Widen extents, count, stamp and average the attributes of matched landmarks."""
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
        """Return the table of landmarks of one kind, and their places in it."""
        table = next(table for table in self._tables.values() if ids[0] in table.places)
        return table, np.array([table.places[number] for number in ids])

    def join(self, mean: Array, kept: int, gone: int) -> None:
        """Give one landmark what is known of another one: extent, count, stamps, label and averages."""
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
        average, other = table.attributes[kept], table.attributes[gone]
        for name, value in other.items():
            old = average.get(name, value)
            average[name] = old + share * (value - old)

    def outlines(self, mean: Array) -> tuple[Ints, Array]:
        """Return the ids (k,) of all landmarks and their visible ends (k, 2, 2) in map."""
        tables = self.tables()
        if not tables:
            return np.empty(0, np.int64), np.empty((0, 2, 2))
        ends = [table.model.outline(table.states(mean), table.extents) for table in tables]
        return np.concatenate([table.ids for table in tables]), np.concatenate(ends)

    def landmarks(self, belief: HasBlocks) -> tuple[Landmark, ...]:
        """Return the map in the form users read, by id."""
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
