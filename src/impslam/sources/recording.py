"""Writes messages to an MCAP file that ROS 2 tools and the rosbag source can read."""

from __future__ import annotations

from pathlib import Path

from impslam.sources.mcap_file import LATCHED, McapFile
from impslam.sources.ros_build import message_types, nanoseconds, new
from impslam.sources.ros_writers import Record, encode
from impslam.sources.rosbag import PRESET_TOPIC, PRESET_TYPE
from impslam.types import Message


class McapWriter(McapFile):
    """Writes messages, in the given order, to an MCAP file (profile ros2, CDR, zstd chunks).

    The file appears when the writer is closed without an error; equal messages give equal bytes. Ranges,
    angles and beam times are stored in single precision, as in ROS. Encoder readings are stored as
    JointState positions in their own unit, which the preset defines.

    Parameters
    ----------
    path : file to write; replaced if it exists
    preset : name of the robot's preset, or its config as TOML, written first, on a latched topic
    """

    def __init__(self, path: Path, preset: str = "imp") -> None:
        super().__init__(path)
        self._preset = preset
        self._clock = 0
        self._has_preset = False

    def write(self, message: Message, log_stamp: float | None = None, below: str = "") -> None:
        """Append a message, logged at `log_stamp` (s, default its own stamp) or later.

        Readers sort by the log time; it never goes backwards here, so that they keep the order of writing
        even if the stamps of messages go backwards. `below` is appended to the topic, for the second
        device of a kind.

        Raises
        ------
        MessageError
            If ROS cannot represent the message (beams not equally spaced, stamps before 1970).
        """
        records = list(encode(message))  # first, so that all or none are written
        stamp = nanoseconds(message.stamp if log_stamp is None else log_stamp)
        self._clock = max(self._clock, stamp)
        self._write_preset()
        for topic, kind, data in records:
            self.append(Record(topic + below, kind, data), self._clock)

    def _write_preset(self) -> None:
        if not self._has_preset:
            self._has_preset = True
            data = message_types().serialize_cdr(new(PRESET_TYPE, self._preset), PRESET_TYPE)
            self.append(Record(PRESET_TOPIC, PRESET_TYPE, data), self._clock, LATCHED)

    _close = _write_preset
