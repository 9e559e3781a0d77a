"""Writes an MCAP file of ROS 2 that appears when it is complete."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Self

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from impslam.errors import SourceError
from impslam.paths import written
from impslam.sources.ros_build import message_types
from impslam.sources.ros_writers import Record

_FOREVER = QosTime(2147483647, 4294967295)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)
"""Quality of service of a topic that gives its last message to late subscribers, too."""


class McapFile:
    """Writes records to an MCAP file (profile ros2, CDR, zstd chunks); equal records give equal bytes.

    The file appears when it is closed without an error, and replaces an existing one.
    """

    def __init__(self, path: Path) -> None:
        self._path = Path(path)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        """Open a temporary folder beside the file, because rosbags writes folders."""
        with written(self._path, "check folder and permissions", SourceError):
            self._folder = tempfile.TemporaryDirectory(prefix=".imp-", dir=self._path.parent)
        # The file contains the name within the folder; a fixed name keeps the bytes the same.
        self._writer = Writer(
            Path(self._folder.name) / "log", version=9, storage_plugin=StoragePlugin.MCAP
        )
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._folder:
            if kind is not None:
                self._writer.abort()
                return
            self._close()
            self._writer.close()
            (self._writer.path / "log.mcap").replace(self._path)

    def _close(self) -> None:
        """Append the last records, if any."""

    def append(self, record: Record, clock: int, *qos: Qos) -> None:
        """Append a record, logged at `clock` (ns); `qos` applies to a topic's first record."""
        topic, kind, data = record
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=message_types(), offered_qos_profiles=qos
            )
        self._writer.write(self._connections[topic], clock, data)
