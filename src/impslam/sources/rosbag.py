"""ROS 1 bags, ROS 2 bags (SQLite and MCAP) and single MCAP files, without ROS.

Topics are found by type. Messages come in order of their log time, with the stamps of their headers. Only
the messages of topics in use are deserialised.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Self

from pydantic import PrivateAttr, field_validator
from rosbags.interfaces import Connection

from impslam.columns import ROWS
from impslam.component import parameter, register
from impslam.errors import SourceError
from impslam.sources.base import Mount, Source, Stream
from impslam.sources.parts import Piece
from impslam.sources.ros_frames import Edge, Frames
from impslam.sources.ros_rows import NumberedRecord, RowReader
from impslam.sources.ros_storage import (
    Bag,
    early_version,
    folder_of,
    one_line,
    storage_class,
)
from impslam.sources.ros_topics import (
    CLOUD_TYPE,
    EVENT_TYPE,
    KEPT,
    KINDS,
    MAKE_SCANS,
    TF_TYPES,
    TYPES,
    Counts,
    Use,
    choose,
    choose_wanted,
    count_messages,
    rival_note,
)
from impslam.sources.ros_unread import JointFault, joint_fault, unread_motion
from impslam.sources.scan_frames import ScanFrames
from impslam.types import Message

PART_SIZE = 1 << 23  # bytes of messages held at once, plus the one that exceeds it
PRESET_TOPIC, PRESET_TYPE = "/impslam/preset", "std_msgs/msg/String"
CLIMATE_TYPES = {
    "temperature": ("sensor_msgs/msg/Temperature", "temperature"),
    "humidity": ("sensor_msgs/msg/RelativeHumidity", "relative_humidity"),
}
"""Message type and field of each quantity in `surroundings`."""
WARNING, ERROR = 30, 40  # levels of rcl_interfaces/Log


@register("rosbag")
class RosBag(Source):
    """ROS 1 bag, ROS 2 bag folder (SQLite or MCAP) or MCAP file."""

    describes_robot: ClassVar[bool] = True

    topics: dict[Use, str] = parameter(
        {},
        "1",
        "topic for scan, wheels, velocity, odometry, imu, fix, voltages, image or truth; empty: use none",
    )
    scan_frame: str = parameter(
        "",
        "1",
        "frame of the scans to read from a topic with several; empty: that of its first scan",
    )
    left_joint: str = parameter("", "1", "left wheel in JointState; empty: a name containing left")
    right_joint: str = parameter("", "1", "right wheel in JointState; empty: one containing right")

    _bag: Bag | None = PrivateAttr(default=None)
    _uses: dict[str, Use] = PrivateAttr(default_factory=dict)
    _defaults: dict[str, Use] = PrivateAttr(default_factory=dict)
    _frames: Frames | None = PrivateAttr(default=None)
    _edge: Edge | None = PrivateAttr(default=None)  # the transform that may be odometry
    _mounts: dict[str, Mount] = PrivateAttr(default_factory=dict)
    _antennas: dict[str, Mount] = PrivateAttr(default_factory=dict)
    _idle: dict[str, str] = PrivateAttr(
        default_factory=dict
    )  # why transforms and joints are not read
    _unread: str = PrivateAttr(default="")
    _clouds: list[str] = PrivateAttr(default_factory=list)  # topics of them, if there are no scans
    _watched: tuple[str, ...] = PrivateAttr(default=())
    _preset: str | None = PrivateAttr(default=None)  # None: not read yet
    _position: int = PrivateAttr(default=0)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise the format by the magic bytes of a file, or by the files in a folder."""
        return storage_class(folder_of(path)) is not None

    @classmethod
    def explain_refusal(cls, path: Path) -> str:
        """Say that a file is a ROS 1 bag of an early version."""
        version = early_version(path)
        return version and (
            f"it is a ROS bag of version {version}, of 2010 or earlier; with ROS 1, "
            "`rosbag filter OLD.bag NEW.bag True` writes it in the present version 2.0"
        )

    @field_validator("path")
    @classmethod
    def _is_whole(cls, path: Path) -> Path:
        return folder_of(path)

    def __enter__(self) -> Self:
        self._bag = Bag(self.path)
        try:
            if self._frames is None:
                self._frames = Frames(self.path, self._bag, self._problems, self.scan_frame)
            frames = self._frames
            counts = self._usable(self._bag, frames)
            self._defaults = choose(self.path, self.topics, counts, frames.merged)
            self._uses = choose_wanted(self.wanted, counts) | self._defaults
            odometry = self._default("odometry"), self._edge
            self._mounts, self._antennas = frames.mounts(*odometry), frames.antennas(*odometry)
            if self._preset is None:
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
        """Name of the preset, or the config as TOML, written by the recorder, or the default."""
        return self._preset or self.default_preset

    @property
    def total(self) -> int | None:
        """Number of messages in use."""
        return sum(connection.msgcount for connection in self._used())

    @property
    def position(self) -> int:
        """Number of messages read so far."""
        return self._position

    def kinds(self) -> frozenset[type[Message]]:
        """Return the types of messages of the topics in use."""
        return frozenset(KINDS[use] for use in self._uses.values())

    def unknown_odometry(self) -> str:
        """Name topics of wheels, velocities and poses that are not read as odometry."""
        return self._unread

    def missing_scans(self) -> str:
        """Name point clouds in a log without scans."""
        return f"{', '.join(self._clouds)} is a PointCloud2: {MAKE_SCANS}" if self._clouds else ""

    def mounts(self) -> Mapping[str, Mount]:
        """Return the mounts of the lasers according to TF, by the topic of their scans."""
        return self._mounts

    def antennas(self) -> Mapping[str, Mount]:
        """Return the mounts of the antennas according to TF, by the topic of their fixes."""
        return self._antennas

    def watch_mounts(self, streams: Collection[str]) -> None:
        """Drop scans of these topics while TF moves their laser on the robot."""
        self._watched = tuple(streams)

    def streams(self) -> list[Stream]:
        """Return the topics by name, with their use."""
        counts = count_messages(self._open().connections)
        return [
            Stream(
                topic,
                kind,
                count,
                self._is_used(topic) or kind in TF_TYPES,
                self._note(topic, kind),
                topic in self._defaults,
            )
            for (topic, kind), count in sorted(counts.items())
        ]

    def surroundings(self) -> Mapping[str, tuple[float, float]]:
        """Return the extremes of `Temperature` and `RelativeHumidity` over all their topics."""
        bag, found = self._open(), dict[str, tuple[float, float]]()
        for name, (kind, field) in CLIMATE_TYPES.items():
            topics = [c for c in bag.connections if c.msgtype == kind]
            values: list[float] = []
            with suppress(Exception):  # read up to any damage, which `batches` reports
                for connection, _, data in bag.messages(topics) if topics else ():
                    values.append(float(getattr(bag.decoder(connection)(data), field)))
            if finite := [value for value in values if math.isfinite(value)]:
                found[name] = min(finite), max(finite)
        return found

    def defaults(self) -> Mapping[type[Message], str]:
        """Return the default topic of each kind."""
        return {KINDS[use]: topic for topic, use in self._defaults.items()}

    def _is_used(self, topic: str) -> bool:
        return topic in self._uses or (topic == PRESET_TOPIC and bool(self._preset))

    def _note(self, topic: str, kind: str) -> str:
        edge = self._edge
        if topic in self._uses:
            frames = f": {edge.parent} -> {edge.child}" if edge and topic == edge.topic else ""
            return self._uses[topic] + frames
        if topic in self._idle:
            return self._idle[topic]
        if topic == PRESET_TOPIC:
            return "preset"
        if self._preset and kind in KEPT:  # the log is from our recorder
            return f"kept: {KEPT[kind]}"
        return rival_note(topic, kind, self._defaults)

    def _usable(self, bag: Bag, frames: Frames) -> Counts:
        """Return the numbers of messages, without transforms or joints that contain no odometry."""
        counts = count_messages(bag.connections)
        without_tf = {(t, k): n for (t, k), n in counts.items() if k not in TF_TYPES}
        self._defaults = choose(
            self.path,
            {u: t for u, t in self.topics.items() if u == "scan"},
            without_tf,
            frames.merged,
        )
        clouds = sorted(topic for (topic, kind), n in counts.items() if n and kind == CLOUD_TYPE)
        self._clouds = [] if self._default("scan") else clouds
        self._edge = frames.odometry(self._default("scan"))
        odometry = self._edge.topic if self._edge else None
        faults = self._joint_faults(bag)
        frames_only = {c.topic for c in bag.connections if c.msgtype in TF_TYPES} - {odometry}
        self._idle = {topic: fault.text for topic, fault in faults.items()}
        self._idle |= dict.fromkeys(frames_only, "frames")
        self._unread = unread_motion(bag, faults, self.topics.values())
        return {(topic, kind): n for (topic, kind), n in counts.items() if topic not in self._idle}

    def _joint_faults(self, bag: Bag) -> dict[str, JointFault]:
        """Return why joints are no odometry, by topic, except for topics that the user has named."""
        topics = {c.topic for c in bag.connections if c.msgtype in TYPES["wheels"]}
        joints = self.left_joint, self.right_joint
        found = {t: joint_fault(bag, t, joints) for t in topics - set(self.topics.values())}
        return {topic: fault for topic, fault in sorted(found.items()) if fault is not None}

    def _default(self, use: Use) -> str:
        """Return the default topic of a use, or ""."""
        return next((topic for topic, name in self._defaults.items() if name == use), "")

    def _open(self) -> Bag:
        if self._bag is None:
            raise SourceError(f"{self.path}: the log is not open; use it in a with statement")
        return self._bag

    def _used(self) -> list[Connection]:
        return [
            c
            for c in self._open().connections
            if c.topic in self._uses and c.msgtype in TYPES[self._uses[c.topic]]
        ]

    def _recorded_preset(self, bag: Bag) -> str:
        found = [c for c in bag.connections if c.topic == PRESET_TOPIC and c.msgtype == PRESET_TYPE]
        try:
            for connection, _, data in bag.messages(found) if found else ():
                return str(bag.decoder(connection)(data).data)
        except SourceError:
            raise
        except Exception as error:  # rosbags may raise anything on damaged data
            self._problems.add("unreadable preset", f"{self.path}: {one_line(error)}; set one")
        return ""

    def _parts(self, rows: int) -> Iterator[list[Piece]]:
        """Yield the rows of some messages at a time."""
        bag = self._open()
        if bag.is_cut:
            self._problems.add(
                "cut file",
                f"{self.path}: {bag.damage}; complete records are used; other programs need "
                f"`{bag.repair}` first",
            )
        joints = (self.left_joint, self.right_joint)
        reader = RowReader(self.path, bag, self._uses, joints, self._edge, self._problems)
        for records in self._records(bag, rows):
            yield reader.part(records)

    def _records(self, bag: Bag, rows: int) -> Iterator[list[NumberedRecord]]:
        """Yield the messages in use, some at a time."""
        assert self._frames is not None
        used, watch = self._used(), self._frames.watch(self._mounts, self._watched)
        events = [c for c in bag.connections if self._preset and c.msgtype == EVENT_TYPE]
        watched = self._frames.publishers(bag, watch.pairs)
        others = [c for c in (*events, *watched) if c not in used]
        topics, odometry = {c.topic for c in used}, self._edge
        frames = ScanFrames(self.path, bag, self._frames.written, self._problems)
        self._position = 0
        records: list[NumberedRecord] = []
        size = 0
        for connection, log_time, data in self._raw(bag, [*used, *others]):
            if connection in watched and watch.may_be_in(data):
                watch.update(self._frames.links(bag, connection, data))
            if connection.topic not in topics:
                self._report_event(connection, data)
                continue
            self._position += 1
            if connection.msgtype in TF_TYPES and not (odometry and odometry.is_in(data)):
                continue
            if frames.leaves_out(connection, data):
                continue
            if moved := watch.moved(connection.topic):
                self._report_moved(connection.topic, moved)
                continue
            records.append(NumberedRecord(self._position, connection, log_time, data))
            size += len(data)
            if len(records) >= min(rows, ROWS) or size > PART_SIZE:
                yield records
                records, size = [], 0
        if records:
            yield records

    def _report_event(self, connection: Connection, data: bytes) -> None:
        """Report warnings and errors on the robot, but no other events."""
        if connection.msgtype != EVENT_TYPE:
            return
        with suppress(Exception):  # rosbags may raise anything on damaged data
            event = self._open().decoder(connection)(data)
            if event.level >= WARNING:
                kind = "error on the robot" if event.level >= ERROR else "warning on the robot"
                text = " ".join(f"{event.name}: {event.msg}".split())
                self._problems.add(kind, f"{self.path}: {text}")

    def _report_moved(self, topic: str, moved: str) -> None:
        """Report a scan whose laser has moved since the first scan."""
        self._problems.add(
            "scan on a moved mount",
            f"{self.path}: TF moves the laser of {topic} on the robot by {moved}; scans are dropped "
            "meanwhile; if that is wrong, give its mount with --set sensors.lidar.mount=[x,y,yaw]",
        )

    def _raw(self, bag: Bag, used: Sequence[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield the data in use; report a problem if a damaged log ends early or has gaps."""
        number = 0
        try:
            for number, record in enumerate(bag.messages(used) if used else (), 1):  # noqa: B007
                yield record
        except SourceError:
            raise
        except Exception as error:  # rosbags may raise anything on damaged data
            self._problems.add(
                "damaged file",
                f"{self.path}: ends after {self._position} messages ({one_line(error)}); "
                "the messages before are used; copy it again or repair it",
            )
            return
        if number < (listed := sum(connection.msgcount for connection in used)):
            self._problems.add(
                "missing messages",
                f"{self.path}: contains {number} of the {listed} messages in its index: another "
                "program truncated or overwrote it; these are used; copy it again",
            )
