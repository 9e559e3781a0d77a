"""Parts of a log: rows of its streams with their places in the log, split into batches of any size."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from impslam.columns import Batch, Columns, batches, same_layout, single_row
from impslam.types import Array, Ints, Mask, Message


class LocatedMessage(NamedTuple):
    """A message with its stream and its place in the log, a line or message number.

    Messages of one record share its stamp; only one of them is `checked`, so that it is checked once.
    """

    message: Message
    place: int
    stream: str
    checked: bool = True


class Piece(NamedTuple):
    """Rows of one stream with their places in the log.

    Attributes
    ----------
    columns : m rows
    places : (m,) line or message number of each, for reports of problems
    checked : (m,) whether to check its stamp
    """

    columns: Columns
    places: Ints
    checked: Mask

    @staticmethod
    def of(columns: Columns, places: Ints, checked: bool = True) -> Piece:
        """Return a piece whose rows are all checked, or none."""
        return Piece(columns, places, np.full(len(columns), checked))


def by_stream(part: Iterable[Piece]) -> dict[str, list[Piece]]:
    """Return the pieces of each stream."""
    streams: dict[str, list[Piece]] = {}
    for piece in part:
        streams.setdefault(piece.columns.stream, []).append(piece)
    return streams


def single(located: LocatedMessage, order: int) -> Piece:
    """Return a message as a piece of one row."""
    columns = single_row(located.stream, located.message, order)[located.stream]
    return Piece(columns, np.array([located.place]), np.array([located.checked]))


def gather(messages: Iterable[LocatedMessage], rows: int) -> Iterator[list[Piece]]:
    """Gather messages into parts of at most `rows` rows, with a piece per stream."""
    located: dict[str, list[tuple[int, bool]]] = {}

    def with_stream() -> Iterator[tuple[str, Message]]:
        for message, place, stream, checked in messages:
            located.setdefault(stream, []).append((place, checked))
            yield stream, message

    for batch in batches(with_stream(), rows):
        part = []
        for stream, columns in batch.items():
            pending = located[stream]
            places = np.array(pending[: len(columns)], np.int64)  # except a message read ahead
            del pending[: len(columns)]
            part.append(Piece(columns, places[:, 0], places[:, 1] > 0))
        yield part


def merge_order(*stamps: Array) -> list[Ints]:
    """Return the order of the rows of streams in separate files, merged by their stamps.

    Rows are not sorted within a stream, where stamps may go backwards; at equal stamps the first stream
    comes first, as with `heapq.merge`.
    """
    keys = np.concatenate([np.maximum.accumulate(each) for each in stamps])
    which = np.concatenate([np.full(len(each), i) for i, each in enumerate(stamps)])
    order = np.empty(len(keys), np.int64)
    order[np.lexsort((which, keys))] = np.arange(len(keys))
    return np.split(order, np.cumsum([len(each) for each in stamps])[:-1])


def to_batches(parts: Sequence[Columns], rows: int) -> Iterator[Batch]:
    """Yield the rows of any number of columns as batches, in the order of the log.

    A batch has at most `rows` rows, and ends early if a stream's layout changes.
    """
    streams: dict[str, list[Columns]] = {}
    for columns in parts:
        streams.setdefault(columns.stream, []).append(columns)
    if not parts:
        return
    if len(streams) == len(parts) and sum(map(len, parts)) <= rows:
        yield {columns.stream: columns for columns in parts}
        return
    runs_by_stream = [_runs(columns) for columns in streams.values()]
    runs = [run for of_stream in runs_by_stream for run in of_stream]
    order = np.sort(np.concatenate([run.order for run in runs]))
    changes = [run.order[0] for of_stream in runs_by_stream for run in of_stream[1:]]
    begins = np.union1d(order[::rows], np.array(changes, np.int64))
    found: list[dict[str, Columns]] = [{} for _ in begins]
    for run in runs:
        which = np.searchsorted(begins, run.order, "right") - 1
        for part in _constant_slices(which):
            found[which[part.start]][run.stream] = run.take(part)
    yield from found


def _runs(parts: Sequence[Columns]) -> list[Columns]:
    """Join columns of one stream into one for each run of rows with equal layout."""
    if len(parts) == 1:
        return list(parts)
    groups: list[list[Columns]] = []
    for columns in parts:
        known = next((group for group in groups if same_layout(group[0], columns)), None)
        if known is None:
            groups.append([columns])
        else:
            known.append(columns)
    joined = [_join(group) for group in groups]
    order = np.concatenate([columns.order for columns in joined])
    layouts = np.concatenate([np.full(len(c), i) for i, c in enumerate(joined)])
    layouts = layouts[np.argsort(order)]
    taken = [0] * len(joined)
    runs = []
    for part in _constant_slices(layouts):
        k, n = layouts[part.start], part.stop - part.start
        runs.append(joined[k].take(slice(taken[k], taken[k] + n)))
        taken[k] += n
    return runs


def _join(group: Sequence[Columns]) -> Columns:
    if len(group) == 1:
        return group[0]
    first = group[0]
    order = np.concatenate([columns.order for columns in group])
    values = {
        name: np.concatenate([columns.values[name] for columns in group]) for name in first.values
    }
    joined = Columns(first.stream, first.kind, order, values, first.layout)
    return joined.take(np.argsort(order))


def _constant_slices(which: Ints) -> list[slice]:
    """Return the slices in which an array (m,) is constant."""
    begins = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist()]
    return [slice(a, b) for a, b in zip(begins, [*begins[1:], len(which)], strict=True)]
