"""Converts messages of this package to serialised ROS 2 messages with topic and type.

The inverse of `ros_messages`. Header stamps are those of the messages; frames follow REP 105.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from impslam.errors import MessageError
from impslam.sources.ros_build import (
    header_of,
    message_types,
    new,
    planar,
    time_of,
    topic_name,
    xyz,
)
from impslam.sources.ros_messages import LEFT, RIGHT
from impslam.sources.ros_storage import RosMessage
from impslam.types import (
    Acceleration,
    Array,
    Climate,
    DeviceTime,
    EncoderVoltages,
    Event,
    Image,
    Imu,
    LaserScan,
    MagneticField,
    Message,
    OdometryPose,
    SatelliteFix,
    TruePose,
    Velocity,
    WheelAngles,
)

LEVELS = {"info": 20, "warning": 30, "error": 40}  # INFO, WARN and ERROR of rcl_interfaces/Log
UNKNOWN_VARIANCE = 0.0  # by the convention of sensor_msgs


def _spacing(name: str, values: Array) -> float:
    """Return the step of equally spaced values; raise `MessageError` if they are not."""
    if len(values) < 2:
        return 0.0
    step = (float(values[-1]) - float(values[0])) / (len(values) - 1)
    if not np.allclose(np.diff(values), step, rtol=0.0, atol=1e-6):
        raise MessageError(f"{name} are not equally spaced, as sensor_msgs/LaserScan requires")
    return step


def _scan(message: LaserScan) -> RosMessage:
    if len(message.ranges) == 0:
        raise MessageError("a scan without beams cannot be recorded")
    step, wait = _spacing("angles", message.angles), _spacing("times", message.time_offsets)
    intensities = np.empty(0) if message.intensities is None else message.intensities
    return new(
        "sensor_msgs/msg/LaserScan",
        header_of(message.stamp, "laser"),
        float(message.angles[0]),
        float(message.angles[-1]),
        step,
        wait,
        wait * len(message.ranges),
        message.range_min,
        message.range_max,
        message.ranges.astype(np.float32),
        intensities.astype(np.float32),
    )


def _wheels(message: WheelAngles) -> RosMessage:
    position, none = np.array([message.left, message.right], np.float64), np.empty(0)
    header = header_of(message.stamp, "")
    return new("sensor_msgs/msg/JointState", header, [LEFT, RIGHT], position, none, none)


def _voltages(message: EncoderVoltages) -> RosMessage:
    """Return the left encoder in x and the right one in y, V, as no standard type has a pair."""
    both = xyz("Vector3", np.array([message.left, message.right, 0.0]))
    return new("geometry_msgs/msg/Vector3Stamped", header_of(message.stamp, ""), both)


def _imu(message: Imu) -> RosMessage:
    unknown, known = np.zeros(9), np.zeros(9)
    unknown[0] = -1.0
    turn = message.orientation
    return new(
        "sensor_msgs/msg/Imu",
        header_of(message.stamp, "imu"),
        xyz("Quaternion", np.array([0.0, 0.0, 0.0, 1.0]) if turn is None else turn),
        unknown if turn is None else known,
        xyz("Vector3", message.angular_velocity),
        known,
        xyz("Vector3", message.linear_acceleration),
        known,
    )


def _fix(message: SatelliteFix) -> RosMessage:
    """Return a GPS fix with the covariance of east, north and up; type 0 (unknown) or 3 (known)."""
    known = bool(np.isfinite(message.covariance).all())
    status = new("sensor_msgs/msg/NavSatStatus", message.status, 1)
    covariance = message.covariance.ravel() if known else np.zeros(9)
    place = (message.latitude, message.longitude, message.altitude)
    header = header_of(message.stamp, "base_link")
    return new("sensor_msgs/msg/NavSatFix", header, status, *place, covariance, 3 if known else 0)


def _acceleration(message: Acceleration) -> RosMessage:
    linear, angular = xyz("Vector3", message.linear_acceleration), xyz("Vector3", np.zeros(3))
    both = new("geometry_msgs/msg/Accel", linear, angular)
    return new("geometry_msgs/msg/AccelStamped", header_of(message.stamp, "imu"), both)


def _magnetic(message: MagneticField) -> RosMessage:
    field = xyz("Vector3", message.field)
    return new("sensor_msgs/msg/MagneticField", header_of(message.stamp, "imu"), field, np.zeros(9))


def _temperature(message: Climate) -> RosMessage:
    header = header_of(message.stamp, "base_link")
    return new("sensor_msgs/msg/Temperature", header, message.temperature, UNKNOWN_VARIANCE)


def _humidity(message: Climate) -> RosMessage:
    header = header_of(message.stamp, "base_link")
    return new("sensor_msgs/msg/RelativeHumidity", header, message.humidity, UNKNOWN_VARIANCE)


def _device_time(message: DeviceTime) -> RosMessage:
    header, device = header_of(message.stamp, ""), time_of(message.device_stamp)
    return new("sensor_msgs/msg/TimeReference", header, device, message.device)


def _event(message: Event) -> RosMessage:
    level = LEVELS.get(message.level, LEVELS["error"])
    return new(
        "rcl_interfaces/msg/Log",
        time_of(message.stamp),
        level,
        message.source,
        message.text,
        *("", "", 0),  # no file, function and line
    )


def _velocity(message: Velocity) -> RosMessage:
    forward = xyz("Vector3", np.array([message.speed, 0.0, 0.0]))
    turn = xyz("Vector3", np.array([0.0, 0.0, message.turn_rate]))
    twist = new("geometry_msgs/msg/Twist", forward, turn)
    return new("geometry_msgs/msg/TwistStamped", header_of(message.stamp, "base_link"), twist)


def _image(message: Image) -> RosMessage:
    data = np.frombuffer(message.data, np.uint8)
    header = header_of(message.stamp, "camera")
    return new("sensor_msgs/msg/CompressedImage", header, message.format, data)


def pose(message: OdometryPose | TruePose) -> RosMessage:
    """Return a pose in the plane as `nav_msgs/Odometry`, in map (the truth) or odom."""
    frame = "map" if isinstance(message, TruePose) else "odom"
    place = planar(message.pose)
    still = xyz("Vector3", np.zeros(3))
    return new(
        "nav_msgs/msg/Odometry",
        header_of(message.stamp, frame),
        "base_link",
        new("geometry_msgs/msg/PoseWithCovariance", place, np.zeros(36)),
        new(
            "geometry_msgs/msg/TwistWithCovariance",
            new("geometry_msgs/msg/Twist", still, still),
            np.zeros(36),
        ),
    )


class Channel(NamedTuple):
    """Topic of a message ({device} is replaced by its device), ROS type, and conversion."""

    topic: str
    kind: str
    convert: Callable[[Any], RosMessage]


CHANNELS: dict[type[Message], tuple[Channel, ...]] = {
    LaserScan: (Channel("/scan", "sensor_msgs/msg/LaserScan", _scan),),
    WheelAngles: (Channel("/joint_states", "sensor_msgs/msg/JointState", _wheels),),
    OdometryPose: (Channel("/odom", "nav_msgs/msg/Odometry", pose),),
    Imu: (Channel("/imu", "sensor_msgs/msg/Imu", _imu),),
    SatelliteFix: (Channel("/fix", "sensor_msgs/msg/NavSatFix", _fix),),
    Image: (Channel("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", _image),),
    TruePose: (Channel("/ground_truth", "nav_msgs/msg/Odometry", pose),),
    EncoderVoltages: (Channel("/encoders/voltage", "geometry_msgs/msg/Vector3Stamped", _voltages),),
    Acceleration: (
        Channel("/imu/acceleration_2", "geometry_msgs/msg/AccelStamped", _acceleration),
    ),
    MagneticField: (Channel("/imu/magnetic_field", "sensor_msgs/msg/MagneticField", _magnetic),),
    Climate: (
        Channel("/temperature", "sensor_msgs/msg/Temperature", _temperature),
        Channel("/humidity", "sensor_msgs/msg/RelativeHumidity", _humidity),
    ),
    DeviceTime: (Channel("/clock/{device}", "sensor_msgs/msg/TimeReference", _device_time),),
    Event: (Channel("/rosout", "rcl_interfaces/msg/Log", _event),),
    Velocity: (Channel("/cmd_vel", "geometry_msgs/msg/TwistStamped", _velocity),),
}


def base_topic(kind: type[Message]) -> str:
    """Return the topic of a type of message; the name of the type if it cannot be recorded."""
    return CHANNELS[kind][0].topic if kind in CHANNELS else kind.__name__


class Record(NamedTuple):
    """A serialised message of a log."""

    topic: str
    kind: str
    data: memoryview | bytes


def encode(message: Message) -> Iterator[Record]:
    """Yield a message as ROS records: one, or two for `Climate`.

    Raises
    ------
    MessageError
        If ROS cannot represent it (beams not equally spaced, stamps before 1970, no type for it).
    """
    if type(message) not in CHANNELS:
        raise MessageError(f"{type(message).__name__} has no ROS type and cannot be recorded")
    device = topic_name(message.device) if isinstance(message, DeviceTime) else ""
    for topic, kind, convert in CHANNELS[type(message)]:
        data = message_types().serialize_cdr(convert(message), kind)
        yield Record(topic.format(device=device), kind, data)
