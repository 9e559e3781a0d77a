"""Writing messages to one MCAP file that ROS 2 tools and the rosbag source read."""

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
from impslam.sources.ros_writers import TYPES, Record, encode, nanoseconds, new
from impslam.sources.rosbag import PRESET_TOPIC, PRESET_TYPE
from impslam.types import Message

_FOREVER = QosTime(2147483647, 4294967295)
_LATCHED = Qos(
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


class McapWriter:
    """Writes messages, in the order given, to an MCAP file (profile ros2, CDR, zstd chunks).

    The file appears when the writer is closed without an error; the same messages give the same
    bytes. Ranges, angles and beam times are stored in single precision, as ROS has them. Encoder
    readings go into JointState positions in their own unit; the preset says which that is.

    Parameters
    ----------
    path : file to write; replaced if it exists
    preset : name of the robot's preset, written first, on a latched topic
    """

    def __init__(self, path: Path, preset: str = "imp") -> None:
        self._path = Path(path)
        self._preset = preset
        self._connections: dict[str, Connection] = {}
        self._clock = 0
        self._has_preset = False

    def __enter__(self) -> Self:
        """Open a temporary folder beside the file, since rosbags writes folders."""
        try:
            self._folder = tempfile.TemporaryDirectory(prefix=".imp-", dir=self._path.parent)
        except OSError as error:
            raise SourceError(
                f"{self._path}: cannot be written ({error.strerror}); check folder and permissions"
            ) from None
        # The name within is recorded in the file; a fixed one keeps the bytes the same.
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
            self._write_preset()
            self._writer.close()
            (self._writer.path / "log.mcap").replace(self._path)

    def write(self, message: Message, log_stamp: float | None = None, below: str = "") -> None:
        """Append a message, logged at `log_stamp` (s, default its own stamp) or later.

        Readers order by the time of logging; it never runs backwards here, so that the order is
        that of writing even where the stamps of messages run backwards. `below` is appended to the
        topic, for the second device of a kind.

        Raises
        ------
        MessageError
            If the message cannot be said in ROS (beams not equally spaced, stamps before 1970).
        """
        records = list(encode(message))  # all or none of them
        stamp = nanoseconds(message.stamp if log_stamp is None else log_stamp)
        self._clock = max(self._clock, stamp)
        self._write_preset()
        for topic, kind, data in records:
            self._append(Record(topic + below, kind, data))

    def _write_preset(self) -> None:
        if not self._has_preset:
            self._has_preset = True
            data = TYPES.serialize_cdr(new(PRESET_TYPE, self._preset), PRESET_TYPE)
            self._append(Record(PRESET_TOPIC, PRESET_TYPE, data), _LATCHED)

    def _append(self, record: Record, *qos: Qos) -> None:
        topic, kind, data = record
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=TYPES, offered_qos_profiles=qos
            )
        self._writer.write(self._connections[topic], self._clock, data)
