"""The topics of readings, the same in the live map and in the recording."""

from __future__ import annotations

from collections.abc import Collection

from impslam.sources.ros_build import topic_name
from impslam.sources.ros_writers import base_topic
from impslam.types import DeviceTime, Event, Message


class TopicNames:
    """Names the topics of readings, from any thread.

    The first device of a type has the topic of the type, e.g. `/scan`, and each other one a topic of its
    own, e.g. `/scan/rear`. A device whose own topic is `wanted` by the config always has that.
    """

    def __init__(self, wanted: Collection[str] = ()) -> None:
        self._wanted = frozenset(wanted)
        self._first: dict[type[Message], str] = {}  # the device that has the topic of a type

    def topic(self, message: Message, device: str) -> str:
        """Return the topic of a reading."""
        return base_topic(type(message)) + self.suffix(message, device)

    def suffix(self, message: Message, device: str) -> str:
        """Return what is appended to the topic of the type of a reading; "" if the device has that."""
        if isinstance(message, Event | DeviceTime):  # these name their device
            return ""
        kind, own = type(message), f"/{topic_name(device)}"
        if base_topic(kind) + own in self._wanted:
            return own
        return "" if self._first.setdefault(kind, device) == device else own
