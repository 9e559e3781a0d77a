"""Checks that the config reads the streams of the devices."""

from __future__ import annotations

import logging

from impslam.errors import ConfigError
from impslam.streams import Streams
from impslam.types import Message

log = logging.getLogger(__name__)


class StreamCheck:
    """Remembers which streams have come, and why some are not read."""

    def __init__(self, streams: Streams) -> None:
        self._streams = streams
        self._unread: dict[str, tuple[type[Message], str]] = {}
        self._read: set[str] = set()

    def reads(self, kind: type[Message], stream: str) -> bool:
        """Return whether the config reads a stream; log it once if it does not."""
        if stream not in self._read and stream not in self._unread:
            try:
                self._streams.check_reads(kind, stream)
                self._read.add(stream)
            except ConfigError as error:
                self._unread[stream] = kind, str(error)
                log.warning("%s", error)
        return stream in self._read

    def notice(self) -> str:
        """Return why a stream is not read, if one that is wanted instead has not come; else ""."""
        readers = (self._streams.odometry, *self._streams.sensors.values())
        for kind, why in list(self._unread.values()):
            wanted = {reader.stream for reader in readers if issubclass(kind, reader.consumes)}
            if wanted - self._read:
                return why
        return ""
