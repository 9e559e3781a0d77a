"""Which stream of a log each part of a robot reads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from impslam.columns import Batch, Columns
from impslam.component import near_miss
from impslam.errors import ConfigError
from impslam.types import Message


@dataclass(slots=True)
class Reader:
    """A part of the robot that reads a stream: its place in the config and what it understands.

    `stream` is the name that the config gives, or that was found since; empty: none yet.
    """

    place: str
    consumes: type[Message]
    stream: str
    named: bool = field(init=False)

    def __post_init__(self) -> None:
        self.named = bool(self.stream)


class Streams:
    """Streams by who reads them. Without a name it is the first of the kind in the log."""

    def __init__(self, odometry: Reader, sensors: Mapping[str, Reader]) -> None:
        self.odometry, self.sensors = odometry, sensors
        self._all = (odometry, *sensors.values())
        self._seen: set[str] = set()
        _refuse_shared(list(sensors.values()))

    @property
    def wanted(self) -> tuple[str, ...]:
        """The streams that the config names."""
        return tuple(dict.fromkeys(reader.stream for reader in self._all if reader.named))

    def choose(self, defaults: Mapping[type[Message], str]) -> None:
        """Say which stream of a kind to read where the config names none."""
        for reader in self._all:
            if not reader.stream and reader.consumes in defaults:
                reader.stream = defaults[reader.consumes]

    def check(self, streams: Mapping[str, bool]) -> None:
        """Refuse a config that names a stream which a log does not have, or cannot be mapped.

        `streams` tells by name whether each can be.
        """
        for reader in self._all:
            if reader.named and not streams.get(reader.stream):
                named = f"{reader.place}.stream = {reader.stream!r}"
                if reader.stream in streams:
                    what = reader.consumes.__name__
                    raise ConfigError(f"{named}: it holds no {what}; name another stream")
                hint = near_miss(reader.stream, streams)
                raise ConfigError(f"{named}: no such stream in the log; {hint}")

    def check_reads(self, kind: type[Message], stream: str) -> None:
        """Refuse rows that nobody reads: of a kind, or of a stream, that the config has no use for."""
        fit = [reader for reader in self._all if issubclass(kind, reader.consumes)]
        if not fit:
            known = ", ".join(sorted({reader.consumes.__name__ for reader in self._all}))
            raise ConfigError(
                f"this config has no use for {kind.__name__}, it takes {known}; choose another "
                "preset, or another odometry.kind"
            )
        if all(reader.stream not in ("", stream) for reader in fit):
            read = ", ".join(f"{reader.place}.stream = {reader.stream!r}" for reader in fit)
            raise ConfigError(f"no part of the robot reads the stream {stream!r}; there is {read}")

    def used(self, batch: Batch) -> list[Columns]:
        """Return the columns that somebody reads, in the order of their first rows."""
        for columns in sorted(batch.values(), key=_first):
            if columns.stream not in self._seen:
                self._find(columns)
        names = {reader.stream for reader in self._all}
        used = [c for c in batch.values() if c.stream in names and len(c)]
        return used if len(used) < 2 else sorted(used, key=_first)

    def _find(self, columns: Columns) -> None:
        """Give a stream that is new to those that read its kind or name it."""
        self._seen.add(columns.stream)
        named = {reader.stream for reader in self.sensors.values() if reader.named}
        for reader in self._all:
            fits = issubclass(columns.kind, reader.consumes)
            free = reader is self.odometry or columns.stream not in named
            if reader.stream == columns.stream and not fits:
                raise ConfigError(
                    f"{reader.place}.stream = {reader.stream!r}: it holds {columns.kind.__name__}, "
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
                    f"{other.place} and {one.place} both read {what}; name the stream of each: "
                    f"{one.place}.stream = NAME"
                )
