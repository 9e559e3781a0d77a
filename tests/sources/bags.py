"""ROS bags of every storage, message by message."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def header(store: Any, stamp: float = 1.5) -> Any:
    sec, nanosec = divmod(round(stamp * 1e9), 10**9)
    time = store.types["builtin_interfaces/msg/Time"](sec, nanosec)
    cls = store.types["std_msgs/msg/Header"]
    return cls(0, time, "f") if store is ROS1 else cls(time, "f")


def joints(store: Any, names: list[str], position: list[float], stamp: float = 1.5) -> Any:
    none = np.empty(0)
    cls = store.types["sensor_msgs/msg/JointState"]
    return cls(header(store, stamp), names, np.array(position), none, none)


def scan(store: Any, stamp: float = 1.5, start: float = -1.0, n: int = 3, high: float = 8.0) -> Any:
    cls = store.types["sensor_msgs/msg/LaserScan"]
    ranges, none = np.arange(n, dtype=np.float32), np.empty(0, np.float32)
    step = min(0.5, 6.0 / max(n, 1))  # at most a turn
    return cls(header(store, stamp), start, 0.0, step, 0.25, 0.1, 0.0, high, ranges, none)


def odometry(store: Any, turn: tuple[float, ...] = (0, 0, 0, 1), x: float = 1.0) -> Any:
    new = lambda name, *values: store.types[f"geometry_msgs/msg/{name}"](*values)  # noqa: E731
    pose = new("Pose", new("Point", x, 2.0, 0.0), new("Quaternion", *turn))
    still = new("Vector3", 0.0, 0.0, 0.0)
    return store.types["nav_msgs/msg/Odometry"](
        header(store),
        "base",
        new("PoseWithCovariance", pose, np.zeros(36)),
        new("TwistWithCovariance", new("Twist", still, still), np.zeros(36)),
    )


def imu(store: Any, stamp: float, known: float, rate: float) -> Any:
    new = lambda name, *values: store.types[f"geometry_msgs/msg/{name}"](*values)  # noqa: E731
    turn, covariance = new("Quaternion", 0.0, 0.0, 0.6, 0.8), np.zeros(9)
    unknown = np.append(known - 1.0, np.zeros(8))
    rates, forces = new("Vector3", rate, 0.25, -0.5), new("Vector3", 1.0, 2.0, rate)
    cls = store.types["sensor_msgs/msg/Imu"]
    return cls(header(store, stamp), turn, unknown, rates, covariance, forces, covariance)


def twist(store: Any, stamp: float, speed: float, rate: float) -> Any:
    new = lambda name, *values: store.types[f"geometry_msgs/msg/{name}"](*values)  # noqa: E731
    return new(
        "TwistStamped",
        header(store, stamp),
        new("Twist", new("Vector3", speed, 0.0, 0.0), new("Vector3", 0.0, 0.0, rate)),
    )


def image(store: Any, form: str) -> Any:
    cls = store.types["sensor_msgs/msg/CompressedImage"]
    return cls(header(store), form, np.arange(4, dtype=np.uint8))


def bag(path: Path, *entries: tuple[str, Any], store: Any = ROS2) -> Path:
    """Write (topic, message) pairs, logged one per second from 100 s, in any of the formats."""
    if store is ROS1:
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if "mcap" in path.name else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        known: dict[str, Any] = {}
        for i, (topic, message) in enumerate(entries):
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            serialise = store.serialize_ros1 if store is ROS1 else store.serialize_cdr
            writer.write(known[topic], (100 + i) * 10**9, serialise(message, kind))
    return path


def some(path: Path, store: Any = ROS2) -> Path:
    """A bag with some of everything."""
    wheels = joints(store, ["left", "right"], [1.0, 2.0])
    return bag(
        path,
        *[("/js", wheels), ("/scan", scan(store, n=100))] * 20,
        ("/odom", odometry(store)),
        ("/cam", image(store, "png")),
        store=store,
    )
