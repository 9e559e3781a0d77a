"""Builds parts of ROS 2 messages: times, headers, vectors, poses, and topic names."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from impslam.errors import MessageError
from impslam.sources.ros_messages import NANOSECONDS
from impslam.sources.ros_storage import RosMessage
from impslam.types import Array


@cache
def message_types() -> Typestore:
    """Return the messages of the oldest supported release, for compatibility.

    rosbags takes 0.05 s to import them, which programs that write no messages do not need.
    """
    return get_typestore(Stores.ROS2_HUMBLE)


def new(kind: str, *values: Any) -> RosMessage:
    """Return a message of a type with the given fields."""
    return message_types().types[kind](*values)


def nanoseconds(stamp: float) -> int:
    """Convert s to ns; raise `MessageError` outside the range of ROS, 1970 to 2038."""
    if not 0.0 <= stamp < 2.0**31:
        raise MessageError(f"a stamp of {stamp} s does not fit ROS; it must be in 0 to 2^31 s")
    whole = math.floor(stamp)
    return whole * NANOSECONDS + round((stamp - whole) * NANOSECONDS)


def time_of(stamp: float) -> RosMessage:
    """Return a stamp in s as a ROS time."""
    return new("builtin_interfaces/msg/Time", *divmod(nanoseconds(stamp), NANOSECONDS))


def header_of(stamp: float, frame: str) -> RosMessage:
    """Return the header of a message in a frame."""
    return new("std_msgs/msg/Header", time_of(stamp), frame)


def xyz(kind: str, values: Array) -> RosMessage:
    """Return a geometry_msgs message with the fields x, y, z (and w)."""
    return new(f"geometry_msgs/msg/{kind}", *map(float, values))


def planar(pose: Array) -> RosMessage:
    """Return a pose (3,) in the plane as `geometry_msgs/Pose`."""
    x, y, theta = map(float, pose)
    place = xyz("Point", np.array([x, y, 0.0]))
    return new("geometry_msgs/msg/Pose", place, turn(theta))


def turn(theta: float) -> RosMessage:
    """Return a heading as `geometry_msgs/Quaternion`."""
    half = 0.5 * theta
    return xyz("Quaternion", np.array([0.0, 0.0, math.sin(half), math.cos(half)]))


def topic_name(text: str) -> str:
    """Return a text as part of a ROS topic name: letters, digits and _, not starting with a digit."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")
    return name if name and not name[0].isdigit() else f"_{name}"
