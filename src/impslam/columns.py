"""Sensor data as columns: many rows of one stream, stacked field by field.

A log provides hundreds of rows at a time, a live robot one. The size of the batches does not change
any result: `Columns.order` holds the position of each row in the log, counted over all streams. Rows
are never sorted by stamp.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.types import Array, Increment, Ints, Mask, Message, Scan

Values: TypeAlias = npt.NDArray[Any]

ROWS = 512
"""Default rows per batch: the arrays take a few MB for any 2D lidar, and the overhead of Python per row is
well below a microsecond."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """m rows of one stream, in the order of the log.

    Attributes
    ----------
    stream : the stream's name in the log, e.g. a topic
    kind : the message type of the rows
    order : (m,) strictly increasing; position of each row in the log, over all streams
    values : (m, ...) by field name; fields with a value per row, including "stamp" (s)
    layout : by field name; values shared by all rows, e.g. the beam angles of a lidar
    """

    stream: str
    kind: type[Message]
    order: Ints
    values: Mapping[str, Values]
    layout: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.order)

    def __getitem__(self, field: str) -> Any:
        """Return a field: (m, ...) for all rows, or the value that all rows share."""
        return self.values[field] if field in self.values else self.layout[field]

    @property
    def stamps(self) -> Array:
        """Stamps (m,) in s, as in the log."""
        return self.values["stamp"]

    def with_stamps(self, stamps: Array) -> Columns:
        """Return the rows with other stamps (m,), s."""
        return replace(self, values={**self.values, "stamp": stamps})

    def take(self, rows: slice | Ints | Mask) -> Columns:
        """Return some of the rows."""
        values = {name: column[rows] for name, column in self.values.items()}
        return Columns(self.stream, self.kind, self.order[rows], values, self.layout)

    def row(self, k: int) -> Message:
        """Return one row as a message."""
        values = {name: _scalar(column[k]) for name, column in self.values.items()}
        return self.kind(**values, **self.layout)


def join(first: Columns, second: Columns) -> Columns:
    """Concatenate the rows of two columns with the same stream and layout."""
    values = {name: np.concatenate((v, second.values[name])) for name, v in first.values.items()}
    order = np.concatenate((first.order, second.order))
    return Columns(second.stream, second.kind, order, values, second.layout)


Batch: TypeAlias = Mapping[str, Columns]
"""A piece of a log: columns by the name of their stream."""


def batches(messages: Iterable[tuple[str, Message]], rows: int = ROWS) -> Iterator[Batch]:
    """Group (stream, message) pairs into batches of at most `rows` messages.

    A batch ends early if the layout of a stream changes.
    """
    gathered: dict[str, list[tuple[int, Message]]] = {}
    count = 0
    for order, (stream, message) in enumerate(messages):
        previous = gathered.get(stream)
        if previous and not _can_stack(previous[-1][1], message):
            yield _stacked(gathered)
            gathered, count = {}, 0
        gathered.setdefault(stream, []).append((order, message))
        count += 1
        if count >= rows:
            yield _stacked(gathered)
            gathered, count = {}, 0
    if gathered:
        yield _stacked(gathered)


def single_row(stream: str, message: Message, order: int) -> Batch:
    """Return a batch of one row at position `order` of the log."""
    return _stacked({stream: [(order, message)]})


def log_order(batch: Batch) -> Iterator[tuple[str, Message]]:
    """Yield the stream and message of each row of a batch, in the order of the log."""
    streams = list(batch.values())
    rows = sorted((int(o), i, k) for i, c in enumerate(streams) for k, o in enumerate(c.order))
    for _, i, k in rows:
        yield streams[i].stream, streams[i].row(k)


def messages(batches: Iterable[Batch]) -> Iterator[Message]:
    """Yield the rows of batches as messages, in the order of the log."""
    for batch in batches:
        for _, message in log_order(batch):
            yield message


def _stacked(gathered: Mapping[str, list[tuple[int, Message]]]) -> Batch:
    return {stream: _stack(stream, numbered) for stream, numbered in gathered.items()}


def _stack(stream: str, numbered: list[tuple[int, Message]]) -> Columns:
    order = np.array([order for order, _ in numbered], np.int64)
    first = numbered[0][1]
    values: dict[str, Values] = {}
    layout: dict[str, Any] = {}
    for name in _field_names(type(first)):  # type: ignore[arg-type]  # a class can be hashed
        value = getattr(first, name)
        if value is None or name in first.layout_fields:
            layout[name] = value
        else:
            column = [getattr(message, name) for _, message in numbered]
            values[name] = np.array(column, None if _is_numeric(value) else np.object_)
    return Columns(stream, type(first), order, values, layout)


def _is_numeric(value: object) -> bool:
    return isinstance(value, float | int | np.generic | np.ndarray)


def _scalar(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _can_stack(first: Message, other: Message) -> bool:
    """Return whether two messages can be rows of the same columns."""
    if type(first) is not type(other):
        return False
    for name in _field_names(type(first)):  # type: ignore[arg-type]  # a class can be hashed
        a, b = getattr(first, name), getattr(other, name)
        if a is b:
            continue
        if a is None or b is None or _shape(a) != _shape(b):
            return False
        if name in first.layout_fields and not _equal(a, b):
            return False
    return True


@cache
def _field_names(kind: type[Message]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def _shape(value: Any) -> tuple[int, ...]:
    return value.shape if isinstance(value, np.ndarray) else ()


def same_layout(a: Columns, b: Columns) -> bool:
    """Return whether the rows of two columns can be joined."""
    if a.kind is not b.kind or a.layout.keys() != b.layout.keys():
        return False
    for name, column in a.values.items():
        other = b.values[name]
        if column.shape[1:] != other.shape[1:] or column.dtype != other.dtype:
            return False
    return all(v is b.layout[k] or _equal(v, b.layout[k]) for k, v in a.layout.items())


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    both_nan = isinstance(a, float) and math.isnan(a) and math.isnan(b)
    return both_nan or bool(a == b)


class Motions(NamedTuple):
    """m consecutive motions of base_link, each from the end of the previous one; see `Increment`.

    Attributes
    ----------
    stamps : (m,) s, at the end of each
    d_pose : (m, 3) `T_before_after`
    covariance : (m, 3, 3) of the additive error of `d_pose`
    duration : (m,) s, >= 0
    """

    stamps: Array
    d_pose: Array
    covariance: Array
    duration: Array

    def take(self, rows: slice | Ints | Mask) -> Motions:
        """Return some of the motions."""
        return Motions(*(column[rows] for column in self))

    def row(self, k: int) -> Increment:
        """Return one motion."""
        return Increment(
            float(self.stamps[k]), self.d_pose[k], self.covariance[k], float(self.duration[k])
        )


@dataclass(frozen=True, slots=True, eq=False)
class Sweeps:
    """m measurements of one exteroceptive sensor, with the motion of the robot.

    Attributes
    ----------
    sensor : the sensor's name in the config
    columns : the rows as received
    middles : (m,) s on the odometry's clock, middle of each sweep; the estimated pose is that of base_link
        at this time
    twists : (m, 3) m/s, m/s, rad/s, mean body velocity over each sweep
    T_middle_stamp : (m, 3) dead-reckoned motion from the middle of the sweep to the stamp of the row
    stamp_covariance : (m, 3, 3) of that motion
    scans : de-skewed scans for extraction, None for a sensor that does not measure scans
    """

    sensor: str
    columns: Columns
    middles: Array
    twists: Array
    T_middle_stamp: Array
    stamp_covariance: Array
    scans: Scans | None

    def __len__(self) -> int:
        return len(self.columns)

    def take(self, rows: slice | Ints | Mask) -> Sweeps:
        """Return some of the rows."""
        return Sweeps(
            self.sensor, self.columns.take(rows), self.middles[rows], self.twists[rows],
            self.T_middle_stamp[rows], self.stamp_covariance[rows],
            None if self.scans is None else self.scans.take(rows),
        )  # fmt: skip

    def scan(self, k: int) -> Scan | None:
        """Return the scan of one row, or None if the sensor does not measure scans."""
        return None if self.scans is None else self.scans.row(k)


@dataclass(frozen=True, slots=True, eq=False)
class Scans:
    """The columns of `Scan`: m sweeps of n beams each, in base_link at the middle of each sweep.

    `ranges`, `valid`, `directions`, `sigmas` are (m, n), `points` and `origins` (m, n, 2); `angles`
    (n,), `bias`, `range_max` and `laser` (3,) are the same for all; see `Scan`. So is `after` (n,) s, the
    times of the beams after the middle of the sweep, None if nothing is to be de-skewed.
    """

    stamps: Array
    angles: Array
    ranges: Array
    valid: Mask
    points: Array
    directions: Array
    origins: Array
    sigmas: Array
    bias: float
    range_max: float
    laser: Array
    intensities: Array | None = None
    after: Array | None = None

    def take(self, rows: slice | Ints | Mask) -> Scans:
        """Return some of the sweeps."""
        intensities = None if self.intensities is None else self.intensities[rows]
        return Scans(
            self.stamps[rows], self.angles, self.ranges[rows], self.valid[rows], self.points[rows],
            self.directions[rows], self.origins[rows], self.sigmas[rows], self.bias,
            self.range_max, self.laser, intensities, self.after,
        )  # fmt: skip

    def row(self, k: int) -> Scan:
        """Return one sweep, as views."""
        intensities = None if self.intensities is None else self.intensities[k]
        return Scan(
            float(self.stamps[k]), self.angles, self.ranges[k], self.valid[k], self.points[k],
            self.directions[k], self.origins[k], self.sigmas[k], self.bias, self.range_max,
            self.laser, intensities,
        )  # fmt: skip
