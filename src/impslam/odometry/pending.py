"""Sensor rows that wait until odometry covers their time span."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions, Sweeps
from impslam.odometry.synchroniser import PendingSweeps, Synchronised
from impslam.sensors.base import Sensor
from impslam.types import Ints, Mask

_NO_TIMES, _NO_MASK = np.empty(0), np.empty(0, np.bool_)
_NO_SWEEPS = PendingSweeps(
    np.empty(0, np.int64), _NO_TIMES, _NO_TIMES, _NO_TIMES, _NO_MASK, _NO_MASK
)


class PendingRows(NamedTuple):
    """w rows of one sensor that wait for odometry.

    Unusable rows wait like the others, so that all rows leave in order.

    Attributes
    ----------
    name, sensor : the sensor and its name in the config
    columns : the rows
    times : (w,) when they enter the queue and were measured
    """

    name: str
    sensor: Sensor
    columns: Columns
    times: PendingSweeps

    def take(self, rows: slice | Mask) -> PendingRows:
        """Return some of the rows."""
        return self._replace(columns=self.columns.take(rows), times=self.times.take(rows))

    def at(self, order: Ints) -> PendingRows:
        """Return the rows with other positions (w,) in the log at which they enter the queue."""
        return self._replace(times=self.times._replace(order=order))

    def sweeps(self, synchronised: Synchronised) -> Sweeps:
        """Return the rows, all of them usable, as sweeps with their motion."""
        scans = self.sensor.sweeps(self.columns, synchronised.twists)
        return Sweeps(
            self.name, self.columns, synchronised.motions.stamps, synchronised.twists,
            synchronised.T_middle_stamp, synchronised.stamp_covariance, scans,
        )  # fmt: skip


class PendingQueue:
    """First-in, first-out queue of the pending rows of all sensors."""

    def __init__(self) -> None:
        self._parts: list[PendingRows] = []
        self._part = np.empty(0, np.int64)  # index of the part of each pending row

    def __len__(self) -> int:
        return len(self._part)

    def push(self, rows: list[PendingRows]) -> PendingSweeps:
        """Append the rows of a batch; return all pending ones in the order of the log."""
        self._parts += rows
        parts = self._parts
        columns = zip(_NO_SWEEPS, *(rows.times for rows in parts), strict=True)
        pending = PendingSweeps._make(map(np.concatenate, columns))
        lengths = np.array([len(rows.columns) for rows in parts], np.int64)
        self._part = np.repeat(np.arange(len(parts)), lengths)
        if len(parts) > 1:
            arrived = np.concatenate([rows.columns.order for rows in parts])
            order = np.lexsort((arrived, pending.order))
            self._part, pending = self._part[order], pending.take(order)
        return pending

    def pop(self, synchronised: Synchronised) -> list[tuple[Motions, Sweeps]]:
        """Remove the synchronised rows from the front; return the usable ones in runs of one sensor."""
        part = self._part[: len(synchronised.twists)]
        usable = np.zeros(len(part), np.bool_)
        popped: dict[int, Sweeps] = {}
        for i, rows in enumerate(self._parts):
            at = np.flatnonzero(part == i)
            if len(at) == 0:
                continue
            leaving = rows.take(slice(len(at)))
            usable[at] = used = leaving.times.usable
            popped[i] = leaving.take(used).sweeps(synchronised.take(at[used]))
            self._parts[i] = rows.take(slice(len(at), None))
        self._parts = [rows for rows in self._parts if len(rows.columns)]
        self._part = self._part[len(part) :]
        return list(_runs(part[usable], synchronised.motions.take(usable), popped))


def _runs(
    part: Ints, motions: Motions, popped: dict[int, Sweeps]
) -> Iterator[tuple[Motions, Sweeps]]:
    """Yield consecutive rows of the same part, with their motions."""
    borders = np.flatnonzero(np.diff(part, prepend=-1, append=-1))
    ends = dict.fromkeys(popped, 0)
    for begin, end in pairwise(borders.tolist()):
        i = int(part[begin])
        run = slice(ends[i], ends[i] + end - begin)
        ends[i] = run.stop
        sweeps = popped[i]
        is_whole = len(sweeps) == run.stop - run.start
        yield motions.take(slice(begin, end)), sweeps if is_whole else sweeps.take(run)
