"""Converts serialised ROS messages to rows: those of equal layout as a table, others one by one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.interfaces import Connection

from impslam.columns import Columns, same_layout
from impslam.errors import MessageError
from impslam.sources import ros_messages as ros
from impslam.sources.base import Problems
from impslam.sources.parts import LocatedMessage, Piece, single
from impslam.sources.ros_frames import Edge
from impslam.sources.ros_stamps import HeaderStamps
from impslam.sources.ros_storage import Bag, RosMessage, one_line
from impslam.sources.ros_tables import TABLES, Rows, Values, stamps, transforms
from impslam.sources.ros_topics import TF_TYPES, Use
from impslam.sources.ros_unread import NAME_WHEELS, NO_POSITIONS, joint_fault
from impslam.sources.text import check_finite
from impslam.sources.transforms import UNIT_TOLERANCE
from impslam.types import Ints, Mask, Message, WheelAngles

READERS: dict[Use, Callable[[RosMessage, float], Message]] = {
    "truth": ros.read_truth,
    "scan": ros.read_scan,
    "voltages": ros.read_voltages,
    "velocity": ros.read_velocity,
    "odometry": ros.read_odometry,
    "imu": ros.read_imu,
    "fix": ros.read_fix,
    "image": ros.read_image,
}
MIN_TABLE_ROWS = 4  # fewer messages are read faster one by one


class NumberedRecord(NamedTuple):
    """A serialised message; `place` is its number among those in use."""

    place: int
    connection: Connection
    log_time: int
    data: bytes


class RowReader:
    """Converts records to rows.

    Parameters
    ----------
    path : the log, for reports of problems
    bag : the open log
    uses : what the messages of each topic are used for
    joints : names of the left and right wheel joints; empty to find them
    odometry : the transform that is odometry, if any
    problems : collects problems with messages
    """

    def __init__(
        self,
        path: Path,
        bag: Bag,
        uses: Mapping[str, Use],
        joints: tuple[str, str],
        odometry: Edge | None,
        problems: Problems,
    ) -> None:
        self._path, self._bag, self._uses, self._joints = path, bag, uses, joints
        self._odometry, self._problems = odometry, problems
        wheels = [topic for topic, use in uses.items() if use == "wheels"]
        self._wheel_topics = {topic for topic in wheels if joint_fault(bag, topic, joints) is None}
        self._stamps = HeaderStamps(path, bag, uses, odometry, problems)

    def part(self, records: Sequence[NumberedRecord]) -> list[Piece]:
        """Return the rows of some messages."""
        part = []
        remaining = dict.fromkeys(record.place for record in records)
        for group in _grouped(records):
            piece = self._read_table(group)
            if piece is not None:
                part.append(piece)
                for place in piece.places.tolist():
                    del remaining[place]
        for record in records:
            if record.place in remaining:
                part += self._read_one(record)
        return part

    def _read_table(self, group: Sequence[NumberedRecord]) -> Piece | None:
        """Return the rows of the valid messages of equal layout in a group, if there are any."""
        connection = group[0].connection
        kind = connection.msgtype
        if len(group) < MIN_TABLE_ROWS or not (kind in TABLES or kind in TF_TYPES):
            return None
        with suppress(Exception):  # invalid messages are reported one by one
            rows = Rows([r.data for r in group], kind, self._bag.types, self._bag.is_ros1)
            values, good, nanoseconds = self._columns(rows, self._bag.decoder(connection), group[0])
            good &= rows.alike & (nanoseconds != 0)
            k = int(good.argmax())
            message = self._read(group[k]) if good[k] else None
            if message is None:
                return None
            first = single(LocatedMessage(message, 0, connection.topic), 0).columns
            places = np.array([record.place for record in group])[good]
            values = {name: column[good] for name, column in values.items()}
            values["stamp"] = stamps(nanoseconds[good].tolist())
            columns = Columns(connection.topic, first.kind, places, values, first.layout)
            if _same(columns.take(slice(0, 1)), first):
                return Piece.of(columns, places)
        return None

    def _columns(
        self, rows: Rows, decode: Callable[[bytes], RosMessage], first: NumberedRecord
    ) -> tuple[Values, Mask, Ints]:
        """Return columns, which of their rows are valid, and stamps in ns; raise if there are none."""
        kind, joints = first.connection.msgtype, None
        if kind in TF_TYPES:
            index = self._odometry.find(decode(first.data)) if self._odometry else None
            prefix = f"transforms.{index}."
            return *transforms(rows, prefix), rows.nanoseconds(prefix)
        if self._uses[first.connection.topic] == "wheels":
            joints = ros.find_joints(decode(first.data).name, *self._joints)
        return *TABLES[kind](rows, joints), rows.nanoseconds()

    def _read_one(self, record: NumberedRecord) -> Iterator[Piece]:
        """Yield the row of any message, or report a problem."""
        topic = record.connection.topic
        try:
            message = self._read(record)
        except Exception as error:  # rosbags may raise anything on damaged data
            self._problems.add(
                f"malformed {self._uses[topic]} message",
                f"{self._path}:{record.place}: {topic}: {one_line(error)}; the message is dropped",
            )
        else:
            if message is not None:
                yield single(LocatedMessage(message, record.place, topic), record.place)

    def _read(self, record: NumberedRecord) -> Message | None:
        """Return a record as a message; None if it has only other transforms or joints than needed."""
        topic = record.connection.topic
        message = self._bag.decoder(record.connection)(record.data)
        if record.connection.msgtype in TF_TYPES:
            message = self._odometry.pick(message) if self._odometry else None
            if message is None:
                return None
        stamp = ros.seconds(self._stamps.of(message, topic, record.log_time))
        use = self._uses[topic]
        if use == "wheels":
            return self._wheels(topic, message, stamp)
        found = READERS[use](message, stamp)
        if use == "scan":
            self._check_increments(message, topic)
        if use == "odometry":
            self._check_norm(ros.quaternion_norm(message), topic, stamp)
        return found

    def _check_increments(self, message: RosMessage, topic: str) -> None:
        """Report a scan whose angle or time from beam to beam is unknown."""
        if ros.angle_step(message) != message.angle_increment:
            self._problems.add(
                "no angle increment",
                f"{self._path}: {topic}: the angle from beam to beam is {message.angle_increment:g}; it "
                "is computed from angle_min and angle_max",
            )
        if math.isnan(message.time_increment):
            self._problems.add(
                "no time increment",
                f"{self._path}: {topic}: the time from beam to beam is NaN; it counts as 0: give the "
                "duration of a sweep with --set sensors.lidar.sweep_time, or correct the driver",
            )

    def _check_norm(self, norm: float, topic: str, stamp: float) -> None:
        """Report a quaternion of odometry that is not normalised; its direction is used."""
        if abs(norm**2 - 1.0) > UNIT_TOLERANCE:
            self._problems.add(
                "quaternion not normalised",
                f"{self._path}: {topic}: the quaternion at {stamp:.3f} s has the norm {norm:.3g} instead "
                "of 1; its direction is used: check the driver, which may write an angle instead",
            )

    def _wheels(self, topic: str, message: RosMessage, stamp: float) -> WheelAngles | None:
        """Read the wheels of a `sensor_msgs/JointState`; None if only others of the topic have wheels."""
        joints = ros.find_joints(message.name, *self._joints)
        if joints is None:
            if topic in self._wheel_topics:
                return None
            raise MessageError(
                f"no left and right wheel among the joints {', '.join(message.name)}; {NAME_WHEELS}"
            )
        if max(joints) >= len(message.position):
            raise MessageError(NO_POSITIONS)
        left, right = (float(message.position[joint]) for joint in joints)
        check_finite("wheel position", left, right)
        return WheelAngles(stamp, left, right)


def _grouped(records: Iterable[NumberedRecord]) -> Iterable[list[NumberedRecord]]:
    """Return the messages grouped by publisher and size."""
    groups: dict[tuple[int, int], list[NumberedRecord]] = {}
    for record in records:
        groups.setdefault((record.connection.id, len(record.data)), []).append(record)
    return groups.values()


def _same(a: Columns, b: Columns) -> bool:
    """Return whether columns of one row are equal to the byte."""
    return (
        a.values.keys() == b.values.keys()
        and same_layout(a, b)
        and all(a.values[name].tobytes() == b.values[name].tobytes() for name in a.values)
    )
