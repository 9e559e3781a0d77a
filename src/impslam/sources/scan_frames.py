"""Tell scans of several lidars on one topic apart, by the frames in their headers."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

from impslam.sources.ros_storage import RosMessage

_HEADER = 16
"""Bytes before the characters of a frame's name: encapsulation or sequence number, stamp, and length."""


class ScanFrames:
    """Compares the frame of each scan with that of its topic.

    Parameters
    ----------
    frames : the frame of each topic of scans, as written in its messages
    """

    def __init__(self, frames: Mapping[str, str]) -> None:
        self._frames = dict(frames)
        self._written = {topic: _written(frame) for topic, frame in frames.items()}

    def other(self, topic: str, data: bytes, decode: Callable[[bytes], RosMessage]) -> str:
        """Return the frame of a serialised scan if it is another one than that of its topic, else ""."""
        own = self._written.get(topic)
        if own is None or data[: _HEADER + len(own[0])].endswith(own):
            return ""
        frame = str(decode(data).header.frame_id)
        return frame if frame != self._frames[topic] else ""


def _written(frame: str) -> tuple[bytes, bytes]:
    """Return a frame as the strings of ROS 2 and of ROS 1 begin: its length and its characters."""
    name = frame.encode()
    return struct.pack("<I", len(name) + 1) + name, struct.pack("<I", len(name)) + name
