"""Holds the rows of sensors back until the rows that others measured earlier have arrived.

A row of a sensor with a latency arrives by that much later than it was measured. With two lidars of
different latencies, the order of the log is not that in which they measured, and motion can only be
composed forward in time. So each row waits by how much less its sensor is late than the latest one. Time is
that of the newest row of the log, whichever stream it is of, so that batches have no influence. Rows
without a usable stamp do not wait, and no row waits for more than `MAX_ROWS` rows of the log.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from impslam.odometry.pending import PendingRows
from impslam.types import Array, Ints

MAX_ROWS = 2000
"""Two seconds of odometry at 1 kHz. Time may stand still, if no stream has usable stamps any more."""


@dataclass(slots=True)
class _Held:
    """Rows that wait, each until the log is at its time in `due`, (w,) s."""

    rows: PendingRows
    due: Array

    def reached(self, order: Ints, newest: Array, limit: int) -> Ints:
        """Return the index (w,) of the row of the batch at which each is due; none before a later one.

        `order` (r,) and `newest` (r,) s are positions and times of the batch's rows, `limit` is the index
        of the first later row of this sensor. An index of r is after the batch.
        """
        by_time = np.searchsorted(newest, self.due)
        by_time = np.maximum(by_time, np.searchsorted(order, self.rows.times.order))
        indices = np.minimum(by_time, np.searchsorted(order, self.rows.times.order + MAX_ROWS))
        return np.minimum.accumulate(np.append(indices, limit)[::-1])[:0:-1]

    def removed(self, reached: Ints, order: Ints) -> PendingRows:
        """Remove the first rows, which are due at these indices, and return them."""
        count = len(reached)
        leaving = self.rows.take(slice(count)).at(order[reached])
        self.rows, self.due = self.rows.take(slice(count, None)), self.due[count:]
        return leaving


class Holding:
    """Holds rows back by the difference of their sensor's latency to the largest one.

    Parameters
    ----------
    latencies : s, by sensor

    Attributes
    ----------
    is_needed : whether any row has to wait
    """

    def __init__(self, latencies: Mapping[str, float]) -> None:
        largest = max(latencies.values(), default=0.0)
        self._waits = {name: largest - latency for name, latency in latencies.items()}
        self.is_needed = any(wait > 0.0 for wait in self._waits.values())
        self._held: list[_Held] = []
        self._newest, self._last = -np.inf, 0

    def __len__(self) -> int:
        return sum(len(held.due) for held in self._held)

    def release(self, rows: list[PendingRows], order: Ints, times: Array) -> list[PendingRows]:
        """Add the rows of a batch; return those that wait no longer, with the order in which they leave.

        `order` (r,) and `times` (r,) s are those of all rows of the batch, in the order of the log.
        """
        if not len(order):
            return rows
        newest = np.maximum.accumulate(np.append(self._newest, times))[1:]
        for one in rows:
            arrived = newest[np.searchsorted(order, one.times.order)]
            wait = np.where(one.times.by_order, 0.0, self._waits[one.name])
            self._held.append(_Held(one, arrived + wait))
        self._newest, self._last = float(newest[-1]), int(order[-1])
        released, first = list[PendingRows](), dict[str, int]()
        for held in reversed(self._held):
            limit = first.get(held.rows.name, len(order))
            reached = held.reached(order, newest, limit)
            first[held.rows.name] = int(reached[0])
            released.append(held.removed(reached[reached < len(order)], order))
        self._held = [held for held in self._held if len(held.due)]
        return [one for one in reversed(released) if len(one.columns)]

    def flush(self) -> list[PendingRows]:
        """Return all rows that still wait, as if they had arrived last."""
        leaving = [held.rows.at(np.full(len(held.due), self._last)) for held in self._held]
        self._held = []
        return leaving
