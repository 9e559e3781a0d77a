"""Converts ROS messages to messages of this package.

The fields are those of sensor_msgs and nav_msgs, which are the same in ROS 1 and 2, with the conventions
of REP 103, and of `sensor_msgs/Imu` for unknown values (first covariance entry -1).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from impslam.errors import MessageError
from impslam.sources.ros_storage import RosMessage
from impslam.sources.text import beam_angles, beam_times, check_finite
from impslam.sources.transforms import rigid, yaw_of
from impslam.types import (
    Array,
    Image,
    Imu,
    LaserScan,
    OdometryPose,
    SatelliteFix,
    TruePose,
    Velocity,
    WheelAngles,
    range_limits,
)

Joints: TypeAlias = tuple[int, int]

NANOSECONDS = 10**9
LEFT, RIGHT = "left_wheel_joint", "right_wheel_joint"
ABBREVIATIONS = {
    "left": {"l", "fl", "lf", "ml", "lm", "rl", "lr", "bl", "lb"},
    "right": {"r", "fr", "rf", "mr", "rm", "rr", "br", "rb"},
}
"""Words for the sides in names of wheels: front, middle and rear or back, left and right."""


def seconds(nanoseconds: int) -> float:
    """Convert ns to s, correctly rounded (unlike a product with 1e-9)."""
    return nanoseconds / NANOSECONDS


def header_stamp(message: RosMessage) -> int:
    """Return the stamp in a message's header, in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def read_scan(message: RosMessage, stamp: float) -> LaserScan:
    """Read a `sensor_msgs/LaserScan`, or the first echoes of a `MultiEchoLaserScan`."""
    if "Echo" in message.__msgtype__:
        return _scan(message, stamp, _first_echoes(message.ranges), None)
    intensities = message.intensities if len(message.intensities) == len(message.ranges) else None
    return _scan(message, stamp, message.ranges, intensities)


def _first_echoes(beams: Sequence[RosMessage]) -> Array:
    """Return the nearest echo of each beam; later ones are from behind an edge or glass."""
    return np.array([beam.echoes[0] if len(beam.echoes) else math.inf for beam in beams])


def angle_step(message: RosMessage) -> float:
    """Return the angle from beam to beam, rad; if it is 0 or NaN, from the outermost beams."""
    step, gaps = float(message.angle_increment), len(message.ranges) - 1
    if not (step == 0.0 or math.isnan(step)) or gaps < 1:
        return step
    return (float(message.angle_max) - float(message.angle_min)) / gaps


def _scan(message: RosMessage, stamp: float, ranges: Any, intensities: Any) -> LaserScan:
    start, step = float(message.angle_min), angle_step(message)
    n, wait = len(ranges), float(message.time_increment)
    wait = 0.0 if math.isnan(wait) else wait
    check_finite("angle_min, angle_increment or time_increment", start, step, wait)
    if n == 0:
        raise MessageError("the scan has no ranges")
    low, high = range_limits(float(message.range_min), float(message.range_max))
    angles, times = beam_angles(n, start, step), beam_times(n, wait)
    intensities = None if intensities is None else _float64(intensities)
    return LaserScan(stamp, angles, _float64(ranges), times, low, high, intensities)


def read_imu(message: RosMessage, stamp: float) -> Imu:
    """Read a `sensor_msgs/Imu`."""
    rate, force = _vector(message.angular_velocity), _vector(message.linear_acceleration)
    known = message.orientation_covariance[0] != -1.0
    turn = _vector(message.orientation, "xyzw") if known else None
    return Imu(stamp, rate, force, turn)


def read_voltages(message: RosMessage, stamp: float) -> WheelAngles:
    """Read absolute encoders (wrapping) from a `geometry_msgs/Vector3Stamped`: x left, y right, V."""
    left, right = _vector(message.vector, "xy").tolist()
    return WheelAngles(stamp, left, right)


def read_fix(message: RosMessage, stamp: float) -> SatelliteFix:
    """Read a `sensor_msgs/NavSatFix`; a covariance of type 0 or of zeros counts as unknown."""
    known = int(message.position_covariance_type) > 0
    given = np.asarray(message.position_covariance, np.float64).reshape(3, 3)
    covariance = given if known and (np.diag(given) > 0.0).all() else np.full((3, 3), math.nan)
    status = int(message.status.status)
    place = (float(message.latitude), float(message.longitude), float(message.altitude))
    return SatelliteFix(stamp, *place, covariance.copy(), status)


def read_odometry(message: RosMessage, stamp: float) -> OdometryPose:
    """Read the pose of a `nav_msgs/Odometry`, `PoseStamped` or `PoseWithCovarianceStamped`.

    Or the pose of base in odom of a `TransformStamped`.
    """
    if "Transform" in message.__msgtype__:
        read_transform(message)
    return OdometryPose(stamp, _planar(*_position_and_orientation(message)))


def quaternion_norm(message: RosMessage) -> float:
    """Return the norm of the orientation in a message that `read_odometry` reads."""
    return math.hypot(*_vector(_position_and_orientation(message)[1], "xyzw"))


def _position_and_orientation(message: RosMessage) -> tuple[Any, Any]:
    if "Transform" in message.__msgtype__:
        return message.transform.translation, message.transform.rotation
    pose = getattr(message.pose, "pose", message.pose)
    return pose.position, pose.orientation


def read_velocity(message: RosMessage, stamp: float) -> Velocity:
    """Read the twist of base, of a `TwistStamped`, `TwistWithCovarianceStamped` or `nav_msgs/Odometry`."""
    twist = getattr(message.twist, "twist", message.twist)
    speed, rate = float(twist.linear.x), float(twist.angular.z)
    check_finite("twist", speed, rate)
    return Velocity(stamp, speed, rate)


def read_truth(message: RosMessage, stamp: float) -> TruePose:
    """Read the pose of a simulator or of motion capture; see `read_odometry` for its types."""
    return TruePose(stamp, _planar(*_position_and_orientation(message)))


def read_transform(message: RosMessage) -> Array:
    """Return the transform (4, 4) of a `geometry_msgs/TransformStamped`.

    Raises
    ------
    MessageError
        If it is not valid; see `rigid`.
    """
    turn = message.transform.rotation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    shift = message.transform.translation
    return rigid(np.array([shift.x, shift.y, shift.z]), quaternion)


def read_image(message: RosMessage, stamp: float) -> Image:
    """Read a `sensor_msgs/CompressedImage`; its format may contain more than jpeg or png."""
    text = str(message.format).lower()
    for name, forms in (("jpeg", ("jpeg", "jpg")), ("png", ("png",))):
        if any(form in text for form in forms):
            return Image(stamp, name, bytes(message.data))
    raise MessageError(f"image format {text!r} is neither jpeg nor png")


def find_joints(names: Sequence[str], left: str, right: str) -> Joints | None:
    """Return the indices of the left and the right wheel, or None.

    Without exact names, take the first name in alphabetical order that contains "left" ("right"), with
    preference for names that contain "wheel"; else the first wheel whose side is abbreviated, as in
    "wheel_FL_joint". Of four wheels, both are then of the same axle.
    """
    found = (_joint(names, left, "left"), _joint(names, right, "right"))
    return None if None in found else (found[0] or 0, found[1] or 0)


def _joint(names: Sequence[str], exact: str, side: str) -> int | None:
    if exact:
        return names.index(exact) if exact in names else None
    fit = [(("wheel" not in n.lower()), n) for n in names if side in n.lower()]
    fit = fit or [(False, n) for n in names if _is_abbreviated_wheel(n.lower(), side)]
    return names.index(min(fit)[1]) if fit else None


def _is_abbreviated_wheel(name: str, side: str) -> bool:
    return "wheel" in name and not ABBREVIATIONS[side].isdisjoint(re.split(r"[^a-z]+", name))


def _planar(position: RosMessage, orientation: RosMessage) -> Array:
    """Return [x, y, yaw]; the quaternion need not have unit length."""
    yaw = yaw_of(*_vector(orientation, "xyzw").tolist())
    return np.array([*_vector(position, "xy"), yaw])


def _vector(message: RosMessage, names: str = "xyz") -> Array:
    values = [float(getattr(message, name)) for name in names]
    check_finite(f"{type(message).__name__.rsplit('__', 1)[-1]}", *values)
    return np.array(values)


def _float64(values: Any) -> Array:
    with np.errstate(invalid="ignore"):  # signalling NaNs of a damaged log
        return np.asarray(values).astype(np.float64)
