"""Reads many serialised ROS messages of one type and equal layout at once, as columns.

The fields are located by walking the first message with the standard definition of its type. Messages
whose strings or array lengths differ from those of the first are not read here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from impslam.sources import ros_messages as ros
from impslam.sources.transforms import UNIT_TOLERANCE
from impslam.types import Array, Ints, Mask

Values = dict[str, Array]
MAX_FIXED = 4096  # bytes of strings and lengths; messages with more are read one by one


class FieldWalk:
    """Locates the fields of a message in its bytes; raises an exception of any type if it is not valid.

    Attributes
    ----------
    places : (offset, numpy type, count, or None for a scalar) of each field, by its dotted name
    fixed : offsets of the bytes of strings and lengths
    """

    def __init__(self, data: bytes, kind: str, store: Typestore, is_ros1: bool) -> None:
        if not is_ros1 and data[:2] != b"\0\1":
            raise ValueError("not plain little-endian CDR")
        self._data, self._store, self._aligned = data, store, not is_ros1
        self._origin = self._at = 0 if is_ros1 else 4
        self.places: dict[str, tuple[int, np.dtype[Any], int | None]] = {}
        self.fixed: list[int] = list(range(self._at))
        self._message("", kind)

    def _message(self, prefix: str, kind: str) -> None:
        for name, (node, detail) in self._store.get_msgdef(kind).fields:
            self._field(prefix + name, node, detail)

    def _field(self, path: str, node: Any, detail: Any) -> None:
        if node == Nodetype.NAME:
            self._message(f"{path}.", detail)
        elif node == Nodetype.BASE and detail[0] == "string":
            self._skip_fixed(self._length())
        elif node == Nodetype.BASE:
            self._numbers(path, detail[0], None)
        else:
            (inner, what), size = detail
            count = size if node == Nodetype.ARRAY else self._length()
            if inner == Nodetype.BASE and what[0] != "string":
                self._numbers(path, what[0], count)
            else:
                for k in range(count):
                    self._field(f"{path}.{k}", inner, what)

    def _numbers(self, path: str, name: str, count: int | None) -> None:
        dtype = np.dtype(name).newbyteorder("<")
        if count != 0:
            self._align(dtype.itemsize)
        self.places[path] = self._at, dtype, count
        self._at += dtype.itemsize * (1 if count is None else count)
        if self._at > len(self._data):
            raise ValueError("the message is truncated")

    def _length(self) -> int:
        self._align(4)
        length = int.from_bytes(self._data[self._at : self._at + 4], "little")
        self._skip_fixed(4)
        return length

    def _skip_fixed(self, count: int) -> None:
        if self._at + count > len(self._data) or len(self.fixed) + count > MAX_FIXED:
            raise ValueError("the message is truncated, or more names than numbers")
        self.fixed += range(self._at, self._at + count)
        self._at += count

    def _align(self, size: int) -> None:
        if self._aligned:
            self._at += -(self._at - self._origin) % size


class Rows:
    """m messages of one type and equal size.

    Attributes
    ----------
    alike : (m,) which of them have the same strings and lengths as the first
    """

    def __init__(self, datas: Sequence[bytes], kind: str, store: Typestore, is_ros1: bool) -> None:
        walk = FieldWalk(datas[0], kind, store, is_ros1)
        self._places = walk.places
        self._bytes = np.frombuffer(b"".join(datas), np.uint8).reshape(len(datas), -1)
        fixed = self._bytes[:, walk.fixed]
        self.alike: Mask = (fixed == fixed[0]).all(axis=1)

    def __getitem__(self, path: str) -> npt.NDArray[Any]:
        """Return a field of all rows, (m,) or (m, n)."""
        offset, dtype, count = self._places[path]
        size = dtype.itemsize * (1 if count is None else count)
        column = self._bytes[:, offset : offset + size].copy().view(dtype)
        return column[:, 0] if count is None else column

    def wide(self, path: str) -> Array:
        """Return a field as float64."""
        with np.errstate(invalid="ignore"):  # signalling NaNs of a damaged log
            return self[path].astype(np.float64)

    def vectors(self, path: str, names: str = "xyz") -> Array:
        """Return (m, k) components of a vector."""
        return np.stack([self[f"{path}.{name}"] for name in names], axis=1).astype(np.float64)

    def shared(self, *paths: str) -> Mask:
        """Return (m,) which rows have the same bytes in some fields as the first."""
        places = [self._places[path] for path in paths]
        where = [k for offset, dtype, _ in places for k in range(offset, offset + dtype.itemsize)]
        column = self._bytes[:, where]
        same: Mask = (column == column[0]).all(axis=1)
        return same

    def nanoseconds(self, prefix: str = "") -> Ints:
        """Return (m,) the header stamps, ns, of the submessage at this path."""
        stamp = self[f"{prefix}header.stamp.sec"].astype(np.int64) * ros.NANOSECONDS
        stamp += self[f"{prefix}header.stamp.nanosec"]
        return stamp


def scans(rows: Rows, joints: ros.Joints | None) -> tuple[Values, Mask]:
    """Return the columns of `sensor_msgs/LaserScan`, and which rows are valid and of one layout."""
    del joints
    good = rows.shared("angle_min", "angle_increment", "time_increment", "range_min", "range_max")
    # the reader of single messages reports them
    good &= (np.abs(rows["angle_increment"]) > 0.0) & ~np.isnan(rows["time_increment"])
    values = {"ranges": rows.wide("ranges")}
    intensities = rows.wide("intensities")
    if intensities.shape == values["ranges"].shape:
        values["intensities"] = intensities
    return values, good


def wheels(rows: Rows, joints: ros.Joints | None) -> tuple[Values, Mask]:
    """Return the columns of `sensor_msgs/JointState`."""
    if joints is None:
        raise ValueError("no wheels among the joints")
    left, right = (rows["position"][:, joint].copy() for joint in joints)
    return {"left": left, "right": right}, np.isfinite(left + right)


def poses(rows: Rows, joints: ros.Joints | None) -> tuple[Values, Mask]:
    """Return the columns of the pose of `nav_msgs/Odometry`."""
    del joints
    quaternions = rows.vectors("pose.pose.orientation", "xyzw")
    with np.errstate(over="ignore", invalid="ignore"):
        norms2 = (quaternions**2).sum(axis=1)
        good = np.abs(norms2 - 1.0) < 0.99 * UNIT_TOLERANCE  # others are reported one by one
    return _planar(rows.vectors("pose.pose.position", "xy"), quaternions, good)


def transforms(rows: Rows, prefix: str) -> tuple[Values, Mask]:
    """Return the columns of the pose in the transform at this path."""
    quaternions = rows.vectors(f"{prefix}transform.rotation", "xyzw")
    with np.errstate(over="ignore", invalid="ignore"):
        norms2 = (quaternions**2).sum(axis=1)
        good = np.abs(norms2 - 1.0) < 0.99 * UNIT_TOLERANCE  # borderline ones are read one by one
    return _planar(rows.vectors(f"{prefix}transform.translation", "xyz"), quaternions, good)


def _planar(positions: Array, quaternions: Array, good: Mask) -> tuple[Values, Mask]:
    """Return poses [x, y, yaw], and which of the good ones are finite."""
    x, y, z, w = quaternions.T
    with np.errstate(over="ignore", invalid="ignore"):
        good = good & np.isfinite(x + y + z + w) & np.isfinite(positions.sum(axis=1))
        sines, cosines = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
    # numpy's arctan2 may differ in the last bit between machines, and from math's.
    yaws = list(map(math.atan2, sines.tolist(), cosines.tolist()))
    return {"pose": np.column_stack((positions[:, :2], yaws))}, good


def imus(rows: Rows, joints: ros.Joints | None) -> tuple[Values, Mask]:
    """Return the columns of `sensor_msgs/Imu`."""
    del joints
    values = {
        "angular_velocity": rows.vectors("angular_velocity"),
        "linear_acceleration": rows.vectors("linear_acceleration"),
    }
    known = rows["orientation_covariance"][:, 0] != -1.0
    if known[0]:
        values["orientation"] = rows.vectors("orientation", "xyzw")
    good = known == known[0]
    with np.errstate(over="ignore", invalid="ignore"):
        for value in values.values():
            good &= np.isfinite(value.sum(axis=1))
    return values, good


TABLES: dict[str, Callable[[Rows, ros.Joints | None], tuple[Values, Mask]]] = {
    "sensor_msgs/msg/LaserScan": scans,
    "sensor_msgs/msg/JointState": wheels,
    "nav_msgs/msg/Odometry": poses,
    "sensor_msgs/msg/Imu": imus,
}


def stamps(nanoseconds: Iterable[int]) -> Array:
    """Return stamps in s, correctly rounded."""
    return np.array([ros.seconds(n) for n in nanoseconds])
