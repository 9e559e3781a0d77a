"""Tell scans of several lidars on one topic apart, by the frames in their headers."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from rosbags.interfaces import Connection

from impslam.sources.base import Problems
from impslam.sources.ros_storage import Bag

_HEADER = 16
"""Bytes before the characters of a frame's name: encapsulation or sequence number, stamp, and length."""


class ScanFrames:
    """Compares the frame of each scan with that of its topic.

    Parameters
    ----------
    path, bag : the log, and the same opened
    frames : the frame of each topic of scans, as written in its messages
    problems : collects the scans of other frames
    """

    def __init__(self, path: Path, bag: Bag, frames: Mapping[str, str], problems: Problems) -> None:
        self._path, self._bag, self._problems = path, bag, problems
        self._frames = dict(frames)
        self._written = {topic: _written(frame) for topic, frame in frames.items()}

    def leaves_out(self, connection: Connection, data: bytes) -> bool:
        """Return whether a serialised message is a scan of another frame, and report it."""
        topic = connection.topic
        own = self._written.get(topic)
        if own is None or data[: _HEADER + len(own[0])].endswith(own):
            return False
        frame = self._frames[topic]
        with suppress(Exception):  # rosbags may raise anything on damaged data
            frame = self._bag.decoder(connection)(data).header.frame_id
        if frame == self._frames[topic]:
            return False
        self._problems.add(
            "scan of another frame",
            f"{self._path}: {topic} has scans of {frame} and of {self._frames[topic]}, which is read; "
            f"to read the other one, --set source.scan_frame={frame}; to read both, record them on "
            "topics of their own",
        )
        return True


def _written(frame: str) -> tuple[bytes, bytes]:
    """Return a frame as the strings of ROS 2 and of ROS 1 begin: its length and its characters."""
    name = frame.encode()
    return struct.pack("<I", len(name) + 1) + name, struct.pack("<I", len(name)) + name
