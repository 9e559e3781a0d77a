"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and single MCAP files, without ROS.

Topics are found by type. Messages come in the order in which they were logged, at the stamps of
their headers. Only the messages of topics in use are deserialised.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeAlias

from pydantic import PrivateAttr
from rosbags.interfaces import Connection

from impslam.component import near_miss, parameter, register
from impslam.errors import MessageError, SourceError
from impslam.sources import ros_messages as ros
from impslam.sources.base import Source, Stream
from impslam.sources.parts import Located
from impslam.sources.ros_storage import Bag, RosMessage, one_line, storage_class
from impslam.sources.text import finite
from impslam.types import Image, Imu, LaserScan, Message, OdometryPose, TruePose, WheelAngles

Use: TypeAlias = Literal["scan", "wheels", "odometry", "imu", "image", "truth"]

TYPES: dict[Use, str] = {
    "truth": "nav_msgs/msg/Odometry",
    "scan": "sensor_msgs/msg/LaserScan",
    "wheels": "sensor_msgs/msg/JointState",
    "odometry": "nav_msgs/msg/Odometry",
    "imu": "sensor_msgs/msg/Imu",
    "image": "sensor_msgs/msg/CompressedImage",
}
READERS: dict[Use, Callable[[RosMessage, float], Message]] = {
    "truth": ros.read_truth,
    "scan": ros.read_scan,
    "odometry": ros.read_odometry,
    "imu": ros.read_imu,
    "image": ros.read_image,
}
KINDS: dict[Use, type[Message]] = {
    "truth": TruePose,
    "scan": LaserScan,
    "wheels": WheelAngles,
    "odometry": OdometryPose,
    "imu": Imu,
    "image": Image,
}
TRUTH_TOPIC = "/ground_truth"  # and what is below it
PRESET_TOPIC, PRESET_TYPE = "/impslam/preset", "std_msgs/msg/String"
EVENT_TYPE = "rcl_interfaces/msg/Log"
WARNING, ERROR = 30, 40  # levels of rcl_interfaces/Log

KEPT = {
    EVENT_TYPE: "events",
    "sensor_msgs/msg/TimeReference": "a device's clock",
    "sensor_msgs/msg/MagneticField": "magnetic field",
    "sensor_msgs/msg/Temperature": "temperature",
    "sensor_msgs/msg/RelativeHumidity": "humidity",
    "geometry_msgs/msg/AccelStamped": "second accelerometer",
    "geometry_msgs/msg/Vector3Stamped": "encoder voltages",
    "geometry_msgs/msg/TwistStamped": "commanded velocity",
}
"""What else our recorder writes: kept for whoever wants it, of no use for mapping."""


@register("rosbag")
class RosBag(Source):
    """ROS 1 bag, ROS 2 bag folder (SQLite or MCAP) or MCAP file."""

    topics: dict[Use, str] = parameter(
        {}, "1", "topic for scan, wheels, odometry, imu, image or truth; an empty name takes none"
    )
    left_joint: str = parameter("", "1", "left wheel in JointState; empty: a name with left in it")
    right_joint: str = parameter("", "1", "right wheel in JointState; empty: with right in it")

    _bag: Bag | None = PrivateAttr(default=None)
    _uses: dict[str, Use] = PrivateAttr(default_factory=dict)
    _defaults: dict[str, Use] = PrivateAttr(default_factory=dict)
    _preset: str = PrivateAttr(default="")
    _position: int = PrivateAttr(default=0)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Tell by the magic bytes of a file, or the metadata.yaml of a folder."""
        return storage_class(path) is not None

    def __enter__(self) -> Self:
        self._bag = Bag(self.path)
        try:
            counts = _counts(self._bag.connections)
            self._defaults = self._choose(counts)
            self._uses = self._choose_wanted(counts) | self._defaults
            self._preset = self._recorded_preset(self._bag)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        bag, self._bag = self._bag, None
        if bag is not None:
            bag.close()

    @property
    def preset(self) -> str:
        """Name of the preset, or the config as TOML, that the recorder wrote, if it did."""
        return self._preset or self.default_preset

    @property
    def total(self) -> int | None:
        """Number of messages in use."""
        return sum(connection.msgcount for connection in self._used())

    @property
    def position(self) -> int:
        """Number of messages read so far."""
        return self._position

    def streams(self) -> list[Stream]:
        """Return the topics, by name, with what they are used for."""
        counts = _counts(self._open().connections)
        return [
            Stream(
                topic,
                kind,
                count,
                self._is_used(topic),
                self._note(topic, kind),
                topic in self._defaults,
            )
            for (topic, kind), count in sorted(counts.items())
        ]

    def defaults(self) -> Mapping[type[Message], str]:
        """Return the topic to use of each kind."""
        return {KINDS[use]: topic for topic, use in self._defaults.items()}

    def _is_used(self, topic: str) -> bool:
        return topic in self._uses or (topic == PRESET_TOPIC and bool(self._preset))

    def _note(self, topic: str, kind: str) -> str:
        if topic in self._uses:
            return self._uses[topic]
        if topic == PRESET_TOPIC:
            return "preset"
        if self._preset and kind in KEPT:  # the log is one of ours
            return f"kept: {KEPT[kind]}"
        rivals = [use for use, name in TYPES.items() if name == kind]
        taken = {use: name for name, use in self._defaults.items() if use in rivals}
        if not taken:
            return ""
        said = ", ".join(f"{use} is {name}" for use, name in taken.items())
        return (
            f"not read: {said}; set source.topics.{next(iter(taken))}={topic} to use this one "
            "instead, or name it in source.wanted"
        )

    def _open(self) -> Bag:
        if self._bag is None:
            raise SourceError(f"{self.path}: the log is not open; use it in a with statement")
        return self._bag

    def _used(self) -> list[Connection]:
        return [
            c
            for c in self._open().connections
            if c.topic in self._uses and c.msgtype == TYPES[self._uses[c.topic]]
        ]

    def _choose(self, counts: dict[tuple[str, str], int]) -> dict[str, Use]:
        """Return what each topic is used for: what is asked for first, then the fullest of a type."""
        uses: dict[str, Use] = {}
        for use, topic in self.topics.items():
            if topic:
                self._check_topic(use, topic, counts)
                uses[topic] = use
        for use, kind in TYPES.items():
            if use in self.topics:
                continue
            free = [(-n, t) for (t, k), n in counts.items() if k == kind and t not in uses and n]
            fit = [(n, t) for n, t in free if _is_truth(t) == (use == "truth")]
            if fit:
                uses[min(fit)[1]] = use
        return uses

    def _choose_wanted(self, counts: dict[tuple[str, str], int]) -> dict[str, Use]:
        """Return what the topics that are asked for by name are used for."""
        uses: dict[str, Use] = {}
        for topic, kind in counts:
            fit = [use for use, name in TYPES.items() if name == kind]
            if topic in self.wanted and fit:
                is_truth = kind == TYPES["truth"] and _is_truth(topic)
                uses[topic] = "truth" if is_truth else fit[-1]
        return uses

    def _check_topic(self, use: Use, topic: str, counts: dict[tuple[str, str], int]) -> None:
        if (topic, TYPES[use]) not in counts:
            known = [name for name, kind in counts if kind == TYPES[use]]
            raise SourceError(
                f"{self.path}: no topic {topic!r} of type {TYPES[use]} for source.topics.{use}; "
                + (near_miss(topic, known) if known else "the log has none of this type")
            )

    def _recorded_preset(self, bag: Bag) -> str:
        found = [c for c in bag.connections if c.topic == PRESET_TOPIC and c.msgtype == PRESET_TYPE]
        try:
            for connection, _, data in bag.messages(found) if found else ():
                return str(bag.decoder(connection)(data).data)
        except SourceError:
            raise
        except Exception as error:  # rosbags raises anything on damaged data
            self._problems.add("unreadable preset", f"{self.path}: {one_line(error)}; set one")
        return ""

    def _messages(self) -> Iterator[Located]:
        bag, used = self._open(), self._used()
        if bag.is_cut:
            self._problems.add(
                "cut file",
                f"{self.path}: lacks its end (power lost, or still being recorded); whole records "
                "are used; other programs need `mcap recover` first",
            )
        events = [c for c in bag.connections if self._preset and c.msgtype == EVENT_TYPE]
        decode = {connection.id: bag.decoder(connection) for connection in [*used, *events]}
        self._position = 0
        for connection, log_time, data in self._raw(bag, [*used, *events]):
            if connection in events:
                self._enter_event(decode[connection.id], data)
                continue
            self._position += 1
            try:
                message = self._convert(connection.topic, decode[connection.id](data), log_time)
            except Exception as error:  # rosbags raises anything on damaged data
                where = f"{self.path}:{self._position}: {connection.topic}"
                self._problems.add(
                    f"malformed {self._uses[connection.topic]} message",
                    f"{where}: {one_line(error)}; the message is dropped",
                )
            else:
                yield Located(message, self._position, connection.topic)

    def _enter_event(self, decode: Callable[[bytes], RosMessage], data: bytes) -> None:
        """Enter what went wrong on the robot; what it merely did is left alone."""
        with suppress(Exception):  # rosbags raises anything on damaged data
            event = decode(data)
            if event.level >= WARNING:
                kind = "error on the robot" if event.level >= ERROR else "warning on the robot"
                said = " ".join(f"{event.name}: {event.msg}".split())
                self._problems.add(kind, f"{self.path}: {said}")

    def _raw(self, bag: Bag, used: Sequence[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the data in use; a damaged log ends early, which is a problem."""
        try:
            yield from bag.messages(used) if used else ()
        except SourceError:
            raise
        except Exception as error:  # rosbags raises anything on damaged data
            self._problems.add(
                "damaged file",
                f"{self.path}: ends after {self._position} messages ({one_line(error)}); "
                "what precedes is used; copy it again or repair it",
            )

    def _convert(self, topic: str, message: RosMessage, log_time: int) -> Message:
        nanoseconds = ros.header_stamp(message)
        if nanoseconds == 0 and log_time > ros.NANOSECONDS:  # simulations do begin at 0
            nanoseconds = log_time
            self._problems.add(
                "no stamp",
                f"{self.path}: {topic} has headers without a stamp; the time of logging is used",
            )
        stamp = ros.seconds(nanoseconds)
        use = self._uses[topic]
        return self._wheels(message, stamp) if use == "wheels" else READERS[use](message, stamp)

    def _wheels(self, message: RosMessage, stamp: float) -> WheelAngles:
        """Read the wheels of a `sensor_msgs/JointState`."""
        joints = ros.find_joints(message.name, self.left_joint, self.right_joint)
        if joints is None:
            raise MessageError(
                f"no left and right wheel among the joints {', '.join(message.name)}; "
                "name them with --set source.left_joint=NAME --set source.right_joint=NAME"
            )
        left, right = (float(message.position[joint]) for joint in joints)
        finite("wheel position", left, right)
        return WheelAngles(stamp, left, right)


def _counts(connections: Sequence[Connection]) -> dict[tuple[str, str], int]:
    """Return the number of messages by (topic, type)."""
    counts: dict[tuple[str, str], int] = defaultdict(int)
    for connection in connections:
        counts[connection.topic, connection.msgtype] += connection.msgcount
    return dict(counts)


def _is_truth(topic: str) -> bool:
    return topic.startswith(TRUTH_TOPIC)
