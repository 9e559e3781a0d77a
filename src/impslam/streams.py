"""Assigns the streams of a log to the odometry, gyro and sensors that read them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from impslam.columns import ROWS, Batch, Columns
from impslam.component import near_miss
from impslam.errors import ConfigError
from impslam.sources.base import Source
from impslam.types import Message


@dataclass(slots=True)
class Reader:
    """An odometry, gyro or sensor that reads a stream.

    Attributes
    ----------
    place : its table in the config
    consumes : type of message that it reads
    stream : name from the config, or of the stream found in the log; empty if none yet
    named : whether the config names the stream
    """

    place: str
    consumes: type[Message]
    stream: str
    named: bool = field(init=False)

    def __post_init__(self) -> None:
        self.named = bool(self.stream)


class Streams:
    """The readers and their streams. A reader without a name gets the first stream of its kind."""

    def __init__(
        self, odometry: Reader, sensors: Mapping[str, Reader], gyro: Reader | None = None
    ) -> None:
        self.odometry, self.sensors, self.gyro = odometry, sensors, gyro
        self._all = (odometry, *sensors.values(), *([gyro] if gyro else []))
        self._seen: set[str] = set()
        _refuse_shared(list(sensors.values()))

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the streams that the config names."""
        return tuple(dict.fromkeys(reader.stream for reader in self._all if reader.named))

    @property
    def named(self) -> frozenset[str]:
        """Names of the streams that have a reader, as far as they are known."""
        return frozenset(reader.stream for reader in self._all) - {""}

    @property
    def consumes(self) -> tuple[type[Message], ...]:
        """Types of message that the readers read."""
        return tuple(dict.fromkeys(reader.consumes for reader in self._all))

    def choose(self, defaults: Mapping[type[Message], str]) -> None:
        """Set the streams to read by type of message where the config names none."""
        for reader in self._all:
            if not reader.stream and reader.consumes in defaults:
                reader.stream = defaults[reader.consumes]

    def read(self, source: Source, rows: int = ROWS) -> Iterator[Batch]:
        """Yield the batches of an open log, whose default streams are read where the config names none."""
        self.choose(source.defaults())
        yield from source.batches(rows)

    def check(self, streams: Mapping[str, bool]) -> None:
        """Raise `ConfigError` if the config names a stream that the log lacks or that cannot be mapped.

        `streams` maps the names of the log's streams to whether they can be mapped.
        """
        for reader in self._all:
            if reader.named and not streams.get(reader.stream):
                named = f"{reader.place}.stream = {reader.stream!r}"
                if reader.stream in streams:
                    what = reader.consumes.__name__
                    raise ConfigError(f"{named}: it contains no {what}; name another stream")
                hint = near_miss(reader.stream, streams)
                raise ConfigError(f"{named}: no such stream in the log; {hint}")

    def check_reads(self, kind: type[Message], stream: str) -> None:
        """Raise `ConfigError` if nothing in the config reads this type of message from this stream."""
        fit = [reader for reader in self._all if issubclass(kind, reader.consumes)]
        if not fit:
            known = ", ".join(sorted({reader.consumes.__name__ for reader in self._all}))
            raise ConfigError(
                f"this config does not use {kind.__name__}, but {known}; choose another "
                "preset, or another odometry.kind"
            )
        if all(reader.stream not in ("", stream) for reader in fit):
            read = ", ".join(f"{reader.place}.stream = {reader.stream!r}" for reader in fit)
            raise ConfigError(f"nothing in the config reads the stream {stream!r}; there is {read}")

    def used(self, batch: Batch) -> list[Columns]:
        """Return the columns that have a reader, in the order of their first rows."""
        for columns in sorted(batch.values(), key=_first):
            if columns.stream not in self._seen:
                self._find(columns)
        names = {reader.stream for reader in self._all}
        used = [c for c in batch.values() if c.stream in names and len(c)]
        return used if len(used) < 2 else sorted(used, key=_first)

    def _find(self, columns: Columns) -> None:
        """Assign a new stream to the readers of its kind, or to those that name it."""
        self._seen.add(columns.stream)
        named = {reader.stream for reader in self.sensors.values() if reader.named}
        for reader in self._all:
            fits = issubclass(columns.kind, reader.consumes)
            free = reader is self.odometry or columns.stream not in named
            if reader.stream == columns.stream and not fits:
                raise ConfigError(
                    f"{reader.place}.stream = {reader.stream!r}: it contains {columns.kind.__name__}, "
                    f"not {reader.consumes.__name__}; name another stream"
                )
            if fits and free and not reader.stream:
                reader.stream = columns.stream


def _first(columns: Columns) -> int:
    return int(columns.order[0])


def _refuse_shared(sensors: list[Reader]) -> None:
    for i, one in enumerate(sensors):
        for other in sensors[:i]:
            if one.stream == other.stream and (one.stream or one.consumes is other.consumes):
                what = repr(one.stream) if one.stream else f"the stream of {one.consumes.__name__}"
                raise ConfigError(
                    f"{other.place} and {one.place} both read {what}; set the stream of each: "
                    f"{one.place}.stream = NAME"
                )
