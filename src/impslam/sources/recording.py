"""Writing messages to one MCAP file that ROS 2 tools and the rosbag source read."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
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
from rosbags.typesys import Stores, get_typestore

from impslam.errors import MessageError, SourceError
from impslam.sources.ros_messages import LEFT, NANOSECONDS, RIGHT
from impslam.sources.ros_storage import RosMessage
from impslam.sources.rosbag import PRESET_TOPIC, PRESET_TYPE
from impslam.types import (
    Array,
    Image,
    Imu,
    LaserScan,
    Message,
    OdometryPose,
    TruePose,
    WheelAngles,
)

_TYPES = get_typestore(Stores.ROS2_HUMBLE)  # the oldest release in support, whose types last
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


def _new(kind: str, *values: Any) -> RosMessage:
    return _TYPES.types[kind](*values)


def _header(stamp: float, frame: str) -> RosMessage:
    sec, nanosec = divmod(_nanoseconds(stamp), NANOSECONDS)
    time = _new("builtin_interfaces/msg/Time", sec, nanosec)
    return _new("std_msgs/msg/Header", time, frame)


def _nanoseconds(stamp: float) -> int:
    """Return s as ns; `MessageError` outside the range of ROS, 1970 to 2038."""
    if not 0.0 <= stamp < 2.0**31:
        raise MessageError(f"a stamp of {stamp} s does not fit ROS; it must be in 0 to 2^31 s")
    whole = math.floor(stamp)
    return whole * NANOSECONDS + round((stamp - whole) * NANOSECONDS)


def _xyz(kind: str, values: Array) -> RosMessage:
    return _new(f"geometry_msgs/msg/{kind}", *map(float, values))


def _spacing(name: str, values: Array) -> float:
    """Return the step of equally spaced values; `MessageError` if they are not."""
    if len(values) < 2:
        return 0.0
    step = (float(values[-1]) - float(values[0])) / (len(values) - 1)
    if not np.allclose(np.diff(values), step, rtol=0.0, atol=1e-6):
        raise MessageError(f"{name} are not equally spaced, which sensor_msgs/LaserScan cannot say")
    return step


def _scan(message: LaserScan) -> RosMessage:
    if len(message.ranges) == 0:
        raise MessageError("a scan without beams cannot be recorded")
    step, wait = _spacing("angles", message.angles), _spacing("times", message.time_offsets)
    return _new(
        "sensor_msgs/msg/LaserScan",
        _header(message.stamp, "laser"),
        float(message.angles[0]),
        float(message.angles[-1]),
        step,
        wait,
        wait * len(message.ranges),
        message.range_min,
        message.range_max,
        message.ranges.astype(np.float32),
        np.empty(0, np.float32),
    )


def _wheels(message: WheelAngles) -> RosMessage:
    position, none = np.array([message.left, message.right], np.float64), np.empty(0)
    header = _header(message.stamp, "")
    return _new("sensor_msgs/msg/JointState", header, [LEFT, RIGHT], position, none, none)


def _imu(message: Imu) -> RosMessage:
    unknown, known = np.zeros(9), np.zeros(9)
    unknown[0] = -1.0
    turn = message.orientation
    return _new(
        "sensor_msgs/msg/Imu",
        _header(message.stamp, "imu"),
        _xyz("Quaternion", np.array([0.0, 0.0, 0.0, 1.0]) if turn is None else turn),
        unknown if turn is None else known,
        _xyz("Vector3", message.angular_velocity),
        known,
        _xyz("Vector3", message.linear_acceleration),
        known,
    )


def _image(message: Image) -> RosMessage:
    data = np.frombuffer(message.data, np.uint8)
    header = _header(message.stamp, "camera")
    return _new("sensor_msgs/msg/CompressedImage", header, message.format, data)


def _pose(message: OdometryPose | TruePose) -> RosMessage:
    frame = "map" if isinstance(message, TruePose) else "odom"
    x, y, theta = map(float, message.pose)
    turn = np.array([0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0)])
    pose = _new(
        "geometry_msgs/msg/Pose",
        _xyz("Point", np.array([x, y, 0.0])),
        _xyz("Quaternion", turn),
    )
    still = _xyz("Vector3", np.zeros(3))
    return _new(
        "nav_msgs/msg/Odometry",
        _header(message.stamp, frame),
        "base_link",
        _new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
        _new(
            "geometry_msgs/msg/TwistWithCovariance",
            _new("geometry_msgs/msg/Twist", still, still),
            np.zeros(36),
        ),
    )


CHANNELS: dict[type[Message], tuple[str, str, Callable[[Any], RosMessage]]] = {
    LaserScan: ("/scan", "sensor_msgs/msg/LaserScan", _scan),
    WheelAngles: ("/joint_states", "sensor_msgs/msg/JointState", _wheels),
    OdometryPose: ("/odom", "nav_msgs/msg/Odometry", _pose),
    Imu: ("/imu", "sensor_msgs/msg/Imu", _imu),
    Image: ("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", _image),
    TruePose: ("/ground_truth", "nav_msgs/msg/Odometry", _pose),
}


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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._folder:
            if kind is not None:
                self._writer.abort()
                return
            self._write_preset()
            self._writer.close()
            (self._writer.path / "log.mcap").replace(self._path)

    def write(self, message: Message, log_stamp: float | None = None) -> None:
        """Append a message, logged at `log_stamp` (s, default its own stamp) or later.

        Readers order by the time of logging; it never runs backwards here, so that the order is
        that of writing even where the stamps of messages run backwards.

        Raises
        ------
        MessageError
            If the message cannot be said in ROS (beams not equally spaced, stamps before 1970).
        """
        topic, kind, convert = CHANNELS[type(message)]
        data = _TYPES.serialize_cdr(convert(message), kind)
        stamp = _nanoseconds(message.stamp if log_stamp is None else log_stamp)
        self._clock = max(self._clock, stamp)
        self._write_preset()
        self._append(topic, kind, data)

    def _write_preset(self) -> None:
        if not self._has_preset:
            self._has_preset = True
            data = _TYPES.serialize_cdr(_new(PRESET_TYPE, self._preset), PRESET_TYPE)
            self._append(PRESET_TOPIC, PRESET_TYPE, data, _LATCHED)

    def _append(self, topic: str, kind: str, data: memoryview | bytes, *qos: Qos) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=_TYPES, offered_qos_profiles=qos
            )
        self._writer.write(self._connections[topic], self._clock, data)
