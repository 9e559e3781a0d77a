"""Many serialised ROS messages at once, as columns: those of one type whose bytes lie alike.

Fields are found by walking the first message with the standard definition of its type. Messages with
strings or lengths of arrays that differ from its are not among those read here.
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
from impslam.sources.transforms import UNIT
from impslam.types import Array, Ints, Mask

Values = dict[str, Array]
FIXED = 4096  # bytes of strings and lengths; what has more is read one by one


class Walk:
    """Finds the fields of a message in its bytes; raises anything where these are not sound.

    Attributes
    ----------
    places : (offset, type of numpy, count or None for a number) of each field, by its dotted name
    fixed : offsets of the bytes in strings and lengths
    """

    def __init__(self, data: bytes, kind: str, store: Typestore, is_ros1: bool) -> None:
        if not is_ros1 and data[:2] != b"\0\1":
            raise ValueError("not plain little-endian CDR")
        self._data, self._store, self._aligned = data, store, not is_ros1
        self._origin = self._at = 0 if is_ros1 else 4
        self.places: dict[str, tuple[int, np.dtype[Any], int | None]] = {}
        self.fixed: list[int] = list(range(self._at))
        self._message("", kind)

    def _message(self, above: str, kind: str) -> None:
        for name, (node, detail) in self._store.get_msgdef(kind).fields:
            self._field(above + name, node, detail)

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
            raise ValueError("the message is cut short")

    def _length(self) -> int:
        self._align(4)
        length = int.from_bytes(self._data[self._at : self._at + 4], "little")
        self._skip_fixed(4)
        return length

    def _skip_fixed(self, count: int) -> None:
        if self._at + count > len(self._data) or len(self.fixed) + count > FIXED:
            raise ValueError("the message is cut short, or more names than numbers")
        self.fixed += range(self._at, self._at + count)
        self._at += count

    def _align(self, size: int) -> None:
        if self._aligned:
            self._at += -(self._at - self._origin) % size


class Rows:
    """m messages of one type, of the same number of bytes.

    Attributes
    ----------
    alike : (m,) which of them have the strings and lengths of the first
    """

    def __init__(self, datas: Sequence[bytes], kind: str, store: Typestore, is_ros1: bool) -> None:
        walk = Walk(datas[0], kind, store, is_ros1)
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
        """Tell (m,) which rows have the same bytes in some fields as the first."""
        places = [self._places[path] for path in paths]
        where = [k for offset, dtype, _ in places for k in range(offset, offset + dtype.itemsize)]
        column = self._bytes[:, where]
        same: Mask = (column == column[0]).all(axis=1)
        return same

    def nanoseconds(self, above: str = "") -> Ints:
        """Return (m,) the stamps in the headers, of what lies at this path."""
        stamp = self[f"{above}header.stamp.sec"].astype(np.int64) * ros.NANOSECONDS
        stamp += self[f"{above}header.stamp.nanosec"]
        return stamp


def scans(rows: Rows, joints: ros.Joints | None) -> tuple[Values, Mask]:
    """Return the columns of `sensor_msgs/LaserScan`, and which rows are sound and of one layout."""
    del joints
    good = rows.shared("angle_min", "angle_increment", "time_increment", "range_min", "range_max")
    values = {"ranges": rows.wide("ranges")}
    bright = rows.wide("intensities")
    if bright.shape == values["ranges"].shape:
        values["intensities"] = bright
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
        good = (quaternions**2).sum(axis=1) > 1e-5  # zero or nearly so: let it be explained
    return _planar(rows.vectors("pose.pose.position", "xy"), quaternions, good)


def transforms(rows: Rows, above: str) -> tuple[Values, Mask]:
    """Return the columns of the pose in a transform, which lies at this path."""
    quaternions = rows.vectors(f"{above}transform.rotation", "xyzw")
    with np.errstate(over="ignore", invalid="ignore"):
        good = np.abs((quaternions**2).sum(axis=1) - 1.0) < 0.99 * UNIT  # near it: let it be judged
    return _planar(rows.vectors(f"{above}transform.translation", "xyz"), quaternions, good)


def _planar(places: Array, quaternions: Array, good: Mask) -> tuple[Values, Mask]:
    """Return poses [x, y, yaw], and which of the good ones are finite."""
    x, y, z, w = quaternions.T
    with np.errstate(over="ignore", invalid="ignore"):
        good = good & np.isfinite(x + y + z + w) & np.isfinite(places.sum(axis=1))
        sines, cosines = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
    # numpy's arctan2 may differ in the last bit from machine to machine, and from math's.
    yaws = list(map(math.atan2, sines.tolist(), cosines.tolist()))
    return {"pose": np.column_stack((places[:, :2], yaws))}, good


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
