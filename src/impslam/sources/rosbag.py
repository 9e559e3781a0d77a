"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and single MCAP files, without ROS.

Topics are found by type. Messages come in the order in which they were logged, at the stamps of
their headers. Only the messages of topics in use are deserialised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from pydantic import PrivateAttr
from rosbags.interfaces import Connection

from impslam.columns import ROWS, Columns, same_layout
from impslam.component import parameter, register
from impslam.errors import MessageError, SourceError
from impslam.sources import ros_messages as ros
from impslam.sources.base import Source, Stream
from impslam.sources.parts import Located, Piece, single
from impslam.sources.ros_storage import Bag, RosMessage, one_line, storage_class
from impslam.sources.ros_tables import TABLES, Rows, stamps
from impslam.sources.ros_topics import (
    EVENT_TYPE,
    KEPT,
    KINDS,
    TYPES,
    Use,
    choose,
    choose_wanted,
    count_messages,
    rivals,
)
from impslam.sources.text import finite
from impslam.types import Message, WheelAngles

READERS: dict[Use, Callable[[RosMessage, float], Message]] = {
    "truth": ros.read_truth,
    "scan": ros.read_scan,
    "odometry": ros.read_odometry,
    "imu": ros.read_imu,
    "image": ros.read_image,
}
PART = 1 << 23  # bytes of messages held at once, and the one that exceeds them
FEW = 4  # messages that are read one by one in the time that a table takes
PRESET_TOPIC, PRESET_TYPE = "/impslam/preset", "std_msgs/msg/String"
WARNING, ERROR = 30, 40  # levels of rcl_interfaces/Log


class Record(NamedTuple):
    """A serialised message and its number among those in use."""

    place: int
    connection: Connection
    log_time: int
    data: bytes


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
            counts = count_messages(self._bag.connections)
            self._defaults = choose(self.path, self.topics, counts)
            self._uses = choose_wanted(self.wanted, counts) | self._defaults
            self._preset = self._recorded_preset(self._bag)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
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
        counts = count_messages(self._open().connections)
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
        return rivals(topic, kind, self._defaults)

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

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield the rows of some messages: those that lie alike at once, the others one by one."""
        bag = self._open()
        if bag.is_cut:
            self._problems.add(
                "cut file",
                f"{self.path}: lacks its end (power lost, or still being recorded); whole records "
                "are used; other programs need `mcap recover` first",
            )
        for records in self._records(bag, rows):
            part = []
            left = dict.fromkeys(record.place for record in records)
            for group in _alike(records):
                piece = self._at_once(bag, group)
                if piece is not None:
                    part.append(piece)
                    for place in piece.places.tolist():
                        del left[place]
            for record in records:
                if record.place in left:
                    part += self._one(bag, record)
            yield part

    def _records(self, bag: Bag, rows: int) -> Iterator[list[Record]]:
        """Yield the messages in use, some at a time."""
        used = self._used()
        events = [c for c in bag.connections if self._preset and c.msgtype == EVENT_TYPE]
        topics, decoders = {c.topic for c in used}, {c.id: bag.decoder(c) for c in events}
        self._position = 0
        records: list[Record] = []
        size = 0
        for connection, log_time, data in self._raw(bag, [*used, *events]):
            if connection.topic not in topics:
                self._enter_event(decoders[connection.id], data)
                continue
            self._position += 1
            records.append(Record(self._position, connection, log_time, data))
            size += len(data)
            if len(records) >= min(rows, ROWS) or size > PART:
                yield records
                records, size = [], 0
        if records:
            yield records

    def _at_once(self, bag: Bag, group: Sequence[Record]) -> Piece | None:
        """Return the rows of messages on one topic that lie alike and are sound, if any are."""
        topic, kind = group[0].connection.topic, group[0].connection.msgtype
        table = TABLES.get(self._uses[topic])
        if table is None or len(group) < FEW:
            return None
        with suppress(Exception):  # what is not sound is explained one by one
            decode = bag.decoder(group[0].connection)
            message = decode(group[0].data)
            joints = None
            if self._uses[topic] == "wheels":
                joints = ros.find_joints(message.name, self.left_joint, self.right_joint)
            rows = Rows([record.data for record in group], kind, bag.types, bag.is_ros1)
            values, good = table(rows, joints)
            nanoseconds = rows.nanoseconds()
            good &= rows.alike & (nanoseconds != 0)
            k = int(good.argmax())
            message = self._convert(topic, decode(group[k].data), group[k].log_time)
            first = single(Located(message, 0, topic), 0).columns
            places = np.array([record.place for record in group])[good]
            values = {name: column[good] for name, column in values.items()}
            values["stamp"] = stamps(nanoseconds[good].tolist())
            columns = Columns(topic, first.kind, places, values, first.layout)
            if good[k] and _same(columns.take(slice(0, 1)), first):
                return Piece.of(columns, places)
        return None

    def _one(self, bag: Bag, record: Record) -> Iterator[Piece]:
        """Yield the row of any message, or say what is wrong with it."""
        topic = record.connection.topic
        try:
            found = bag.decoder(record.connection)(record.data)
            message = self._convert(topic, found, record.log_time)
        except Exception as error:  # rosbags raises anything on damaged data
            self._problems.add(
                f"malformed {self._uses[topic]} message",
                f"{self.path}:{record.place}: {topic}: {one_line(error)}; the message is dropped",
            )
        else:
            yield single(Located(message, record.place, topic), record.place)

    def _enter_event(self, decode: Callable[[bytes], RosMessage], data: bytes) -> None:
        """Enter what went wrong on the robot; what it merely did is left alone."""
        with suppress(Exception):  # rosbags raises anything on damaged data
            event = decode(data)
            if event.level >= WARNING:
                kind = "error on the robot" if event.level >= ERROR else "warning on the robot"
                said = " ".join(f"{event.name}: {event.msg}".split())
                self._problems.add(kind, f"{self.path}: {said}")

    def _raw(self, bag: Bag, used: Sequence[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the data in use; a damaged log ends early or has gaps, which is a problem."""
        number = 0
        try:
            for number, record in enumerate(bag.messages(used) if used else (), 1):  # noqa: B007
                yield record
        except SourceError:
            raise
        except Exception as error:  # rosbags raises anything on damaged data
            self._problems.add(
                "damaged file",
                f"{self.path}: ends after {self._position} messages ({one_line(error)}); "
                "what precedes is used; copy it again or repair it",
            )
            return
        if number < (told := sum(connection.msgcount for connection in used)):
            self._problems.add(
                "missing messages",
                f"{self.path}: holds {number} of the {told} messages that its index tells of: another "
                "program cut or overwrote it; the others are used; copy it again",
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


def _alike(records: Iterable[Record]) -> Iterable[list[Record]]:
    """Return messages of one publisher and size together."""
    groups: dict[tuple[int, int], list[Record]] = {}
    for record in records:
        groups.setdefault((record.connection.id, len(record.data)), []).append(record)
    return groups.values()


def _same(a: Columns, b: Columns) -> bool:
    """Tell whether columns of one row are the same to the byte."""
    return (
        a.values.keys() == b.values.keys()
        and same_layout(a, b)
        and all(a.values[name].tobytes() == b.values[name].tobytes() for name in a.values)
    )
