"""Sensor rows that wait until odometry covers their time span."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from impslam.columns import Columns, Motions, Sweeps
from impslam.odometry.synchroniser import PendingSweeps, Synchronised
from impslam.sensors.base import Sensor
from impslam.types import Array, Ints, Mask

_TIMES = ("begins", "ends", "stamps")


@dataclass(slots=True, eq=False)
class PendingRows:
    """w rows of one sensor that wait for odometry.

    Unusable rows wait like the others, so that all rows leave in order.

    Attributes
    ----------
    name, sensor : the sensor and its name in the config
    columns : the rows
    order : (w,) positions in the log at which they enter the queue, increasing
    begins, ends, stamps : (w,) s on the common time line of all streams
    usable : (w,) rows that can be used
    by_order : (w,) rows that get the odometry before them in the log, whatever the stamps
    """

    name: str
    sensor: Sensor
    columns: Columns
    order: Ints
    begins: Array
    ends: Array
    stamps: Array
    usable: Mask
    by_order: Mask

    def take(self, rows: slice | Mask) -> PendingRows:
        """Return some of the rows."""
        return replace(
            self,
            columns=self.columns.take(rows),
            order=self.order[rows],
            begins=self.begins[rows],
            ends=self.ends[rows],
            stamps=self.stamps[rows],
            usable=self.usable[rows],
            by_order=self.by_order[rows],
        )

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
        lengths = np.array([len(part.columns) for part in parts], np.int64)
        columns = [
            np.repeat(np.arange(len(parts)), lengths),
            _joined([part.order for part in parts], np.int64),
            *(_joined([getattr(part, name) for part in parts]) for name in _TIMES),
            _joined([part.usable for part in parts], np.bool_),
            _joined([part.by_order for part in parts], np.bool_),
        ]
        if len(parts) > 1:
            arrived = _joined([part.columns.order for part in parts], np.int64)
            order = np.lexsort((arrived, columns[1]))
            columns = [column[order] for column in columns]
        self._part, *pending = columns
        return PendingSweeps(*pending)

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
            usable[at] = leaving.usable
            popped[i] = leaving.take(leaving.usable).sweeps(
                _taken(synchronised, at[leaving.usable])
            )
            self._parts[i] = rows.take(slice(len(at), None))
        self._parts = [rows for rows in self._parts if len(rows.columns)]
        self._part = self._part[len(part) :]
        return list(_runs(part[usable], synchronised.motions.take(usable), popped))


def _joined(columns: list[Any], kind: type = np.float64) -> Any:
    return np.concatenate([np.empty(0, kind), *columns])


def _taken(synchronised: Synchronised, rows: Ints) -> Synchronised:
    return Synchronised(
        synchronised.motions.take(rows),
        synchronised.twists[rows],
        synchronised.T_middle_stamp[rows],
        synchronised.stamp_covariance[rows],
    )


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
