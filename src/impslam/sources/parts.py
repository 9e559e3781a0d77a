"""Parts of a log: the rows of its streams, with their places in it, made into batches of any size."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from impslam.columns import Batch, Columns, batches, same_layout, single_row
from impslam.types import Array, Ints, Mask, Message


class Located(NamedTuple):
    """A message and where it stands in the log: its stream, and a line or message number.

    Messages of one record share its stamp; all but one of them are not `checked`, so that the stamp
    is checked once.
    """

    message: Message
    place: int
    stream: str
    checked: bool = True


class Piece(NamedTuple):
    """Rows of one stream and where they stand in the log.

    Attributes
    ----------
    columns : m rows
    places : (m,) line or message number of each, for whoever explains what is wrong with it
    checked : (m,) whether its stamp is to be checked
    """

    columns: Columns
    places: Ints
    checked: Mask

    @staticmethod
    def of(columns: Columns, places: Ints, checked: bool = True) -> Piece:
        """Return rows that are all checked, or none of them."""
        return Piece(columns, places, np.full(len(columns), checked))


def by_stream(part: Iterable[Piece]) -> dict[str, list[Piece]]:
    """Return the pieces of each stream."""
    streams: dict[str, list[Piece]] = {}
    for piece in part:
        streams.setdefault(piece.columns.stream, []).append(piece)
    return streams


def single(located: Located, order: int) -> Piece:
    """Return a message as a piece of one row."""
    columns = single_row(located.stream, located.message, order)[located.stream]
    return Piece(columns, np.array([located.place]), np.array([located.checked]))


def gather(messages: Iterable[Located], rows: int) -> Iterator[list[Piece]]:
    """Gather messages into pieces, one a stream, of at most `rows` rows together."""
    located: dict[str, list[tuple[int, bool]]] = {}

    def noted() -> Iterator[tuple[str, Message]]:
        for message, place, stream, checked in messages:
            located.setdefault(stream, []).append((place, checked))
            yield stream, message

    for gathered in batches(noted(), rows):
        part = []
        for stream, columns in gathered.items():
            known = located[stream]
            places = np.array(known[: len(columns)], np.int64)  # the one read ahead stays
            del known[: len(columns)]
            part.append(Piece(columns, places[:, 0], places[:, 1] > 0))
        yield part


def turns(*stamps: Array) -> list[Ints]:
    """Return the places in the log of the rows of streams that come in files of their own.

    Rows are not sorted within a stream, as stamps may run backwards there: the stamps say which
    stream's turn it is, the first one's where they are equal (what `heapq.merge` does).
    """
    keys = np.concatenate([np.maximum.accumulate(each) for each in stamps])
    which = np.concatenate([np.full(len(each), i) for i, each in enumerate(stamps)])
    order = np.empty(len(keys), np.int64)
    order[np.lexsort((which, keys))] = np.arange(len(keys))
    return np.split(order, np.cumsum([len(each) for each in stamps])[:-1])


def cut(parts: Sequence[Columns], rows: int) -> Iterator[Batch]:
    """Yield rows, given in any number of columns, in the order of the log.

    A batch has at most `rows` rows, and ends early where a stream's layout changes.
    """
    streams: dict[str, list[Columns]] = {}
    for columns in parts:
        streams.setdefault(columns.stream, []).append(columns)
    if not parts:
        return
    if len(streams) == len(parts) and sum(map(len, parts)) <= rows:
        yield {columns.stream: columns for columns in parts}
        return
    stretches = [_runs(many) for many in streams.values()]
    runs = [run for several in stretches for run in several]
    order = np.sort(np.concatenate([run.order for run in runs]))
    changes = [run.order[0] for several in stretches for run in several[1:]]
    begins = np.union1d(order[::rows], np.array(changes, np.int64))
    found: list[dict[str, Columns]] = [{} for _ in begins]
    for run in runs:
        which = np.searchsorted(begins, run.order, "right") - 1
        for place in _stretches(which):
            found[which[place.start]][run.stream] = run.take(place)
    yield from found


def _runs(many: Sequence[Columns]) -> list[Columns]:
    """Join columns of one stream: one for each stretch of the log in which the layout is the same."""
    if len(many) == 1:
        return list(many)
    alike: list[list[Columns]] = []
    for columns in many:
        known = next((group for group in alike if same_layout(group[0], columns)), None)
        if known is None:
            alike.append([columns])
        else:
            known.append(columns)
    joined = [_join(group) for group in alike]
    order = np.concatenate([columns.order for columns in joined])
    layouts = np.concatenate([np.full(len(c), i) for i, c in enumerate(joined)])
    layouts = layouts[np.argsort(order)]
    taken = [0] * len(joined)
    runs = []
    for place in _stretches(layouts):
        k, n = layouts[place.start], place.stop - place.start
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


def _stretches(which: Ints) -> list[slice]:
    """Return where an array (m,) keeps its value, stretch by stretch."""
    begins = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist()]
    return [slice(a, b) for a, b in zip(begins, [*begins[1:], len(which)], strict=True)]
