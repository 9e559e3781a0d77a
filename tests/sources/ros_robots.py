"""Bags in the manner of ROS users, written from the simulator: frames, odometry and lidars as one asks."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from impslam.geometry.se2 import compose
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World
from impslam.sources.ros_storage import _standard_types
from impslam.types import LaserScan, TruePose, WheelAngles

Entry = tuple[float, str, Any]
Way = Sequence[tuple[str, str, Sequence[float], Sequence[float]]]
"""Links of frames: parent, child, [x, y, z] in m, [roll, pitch, yaw] in rad."""

URDF: Way = (
    ("base_footprint", "base_link", [0, 0, 0.1], [0, 0, 0]),
    ("base_link", "laser", [0.1, 0.05, 0.1], [0, 0, 0]),
)
FULL = Lidar(
    beams=360,
    angle_min=0.0,
    angle_step=math.tau / 360,
    beam_time=0.0,
    range_max=12.0,
    no_return=math.inf,
    mount=(0.1, 0.05, 0.0),
)


@dataclass(frozen=True)
class Laser:
    """A lidar, its topic and frame; `sim` has its true mount. Upside down, it turns the other way."""

    sim: Lidar = FULL
    topic: str = "/scan"
    frame: str = "laser"
    upside_down: bool = False
    echoes: bool = False
    range_max: float = 12.0


@dataclass(frozen=True)
class Recipe:
    """What a bag holds."""

    lasers: Sequence[Laser] = (Laser(),)
    static: Way = URDF
    republished: bool = False  # static transforms in /tf, ten times a second, as in ROS 1
    tf_type: str = "tf2_msgs/msg/TFMessage"
    tf_odometry: tuple[str, str] | None = ("odom", "base_footprint")
    odometry: dict[str, str] = field(default_factory=dict)  # child frame by topic
    ros1: bool = False
    plugin: StoragePlugin = StoragePlugin.MCAP
    compression: CompressionMode = CompressionMode.NONE
    start: float = 1_700_000_000.0
    clock: bool = False


class Types:
    """Makes messages of one version of ROS."""

    def __init__(self, ros1: bool, tf_type: str = Recipe.tf_type) -> None:
        self.store, self.ros1, self.tf_type = _standard_types(ros1), ros1, tf_type

    def new(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def time(self, stamp: float) -> Any:
        return self.new("builtin_interfaces/msg/Time", *divmod(round(stamp * 1e9), 10**9))

    def header(self, stamp: float, frame: str) -> Any:
        first = (0,) if self.ros1 else ()
        return self.new("std_msgs/msg/Header", *first, self.time(stamp), frame)

    def quaternion(self, rpy: Sequence[float]) -> Any:
        (cr, cp, cy), (sr, sp, sy) = np.cos(np.divide(rpy, 2)), np.sin(np.divide(rpy, 2))
        values = (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        )
        return self.new("geometry_msgs/msg/Quaternion", *map(float, values))

    def transform(self, stamp: float, parent: str, child: str, xyz: Any, rpy: Any) -> Any:
        shift = self.new("geometry_msgs/msg/Vector3", *map(float, xyz))
        both = self.new("geometry_msgs/msg/Transform", shift, self.quaternion(rpy))
        header = self.header(stamp, parent)
        return self.new("geometry_msgs/msg/TransformStamped", header, child, both)

    def tf(self, *transforms: Any) -> Any:
        return self.new(self.tf_type, list(transforms))

    def links(self, stamp: float, way: Way) -> Any:
        return self.tf(*(self.transform(stamp, *link) for link in way))

    def odometry(self, stamp: float, child: str, pose: Any) -> Any:
        point = self.new("geometry_msgs/msg/Point", float(pose[0]), float(pose[1]), 0.0)
        place = self.new("geometry_msgs/msg/Pose", point, self.quaternion([0, 0, pose[2]]))
        still = self.new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self.new("geometry_msgs/msg/Twist", still, still)
        return self.new(
            "nav_msgs/msg/Odometry",
            self.header(stamp, "odom"),
            child,
            self.new("geometry_msgs/msg/PoseWithCovariance", place, np.zeros(36)),
            self.new("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
        )

    def scan(self, stamp: float, laser: Laser, message: LaserScan) -> Any:
        angles, ranges = message.angles, message.ranges
        if laser.upside_down:
            angles = -angles
        about = (
            self.header(stamp, laser.frame),
            float(angles[0]),
            float(angles[-1]),
            float(angles[1] - angles[0]),
            float(message.time_offsets[1]),
            0.1,
            message.range_min,
            laser.range_max,
        )
        if not laser.echoes:
            none = np.empty(0, np.float32)
            return self.new("sensor_msgs/msg/LaserScan", *about, ranges.astype(np.float32), none)
        echoes = [[r, r + 0.5] if math.isfinite(r) else [] for r in ranges]
        beams = [
            self.new("sensor_msgs/msg/LaserEcho", np.array(echo, np.float32)) for echo in echoes
        ]
        return self.new("sensor_msgs/msg/MultiEchoLaserScan", *about, beams, [])


def drive(world: World, recipe: Recipe, seed: int = 0) -> tuple[list[Entry], np.ndarray]:
    """Return (time, topic, message) in order, and the truth: stamp, x, y, theta at each first scan."""
    types, streams, truth = Types(recipe.ros1, recipe.tf_type), [], {}
    for k, laser in enumerate(recipe.lasers):
        robot = SimulatedRobot(lidar=laser.sim, imu=None, start_time=0.0)
        messages = list(simulate(world, robot, seed))
        scans = [m for m in messages if isinstance(m, LaserScan)]
        streams.append(
            [
                (
                    m.stamp + m.time_offsets[-1],
                    laser.topic,
                    types.scan(recipe.start + m.stamp, laser, m),
                )
                for m in scans
            ]
        )
        if k == 0:
            poses = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
            truth = {m.stamp: poses[m.stamp] for m in scans}
            streams.append(list(_odometry(types, recipe, robot.encoders, messages)))
    streams.append(list(_frames(types, recipe, max(truth))))
    rows = [(recipe.start + t, *pose) for t, pose in truth.items()]
    return list(heapq.merge(*streams, key=lambda entry: entry[0])), np.array(rows)


def _odometry(
    types: Types, recipe: Recipe, wheels: WheelEncoders | None, messages: list[Any]
) -> Iterator[Entry]:
    """Yield dead reckoning by the wheels, where it is asked for, at 50 Hz, from another place than 0."""
    assert wheels is not None
    pose, last = np.array([3.0, -2.0, 2.0]), None
    for k, m in enumerate(m for m in messages if isinstance(m, WheelAngles)):
        if last is not None:
            left, right = (
                wheels.wheel_radius * (m.left - last.left),
                wheels.wheel_radius * (m.right - last.right),
            )
            turn = (right - left) / wheels.track
            pose = compose(pose, np.array([0.5 * (left + right), 0.0, turn]))
        last, stamp = m, recipe.start + m.stamp
        if k % 2:
            continue
        for topic, child in recipe.odometry.items():
            yield m.stamp, topic, types.odometry(stamp, child, pose)
        if recipe.tf_odometry:
            x, y, yaw = pose
            link = types.transform(stamp, *recipe.tf_odometry, [x, y, 0.0], [0, 0, yaw])
            yield m.stamp, "/tf", types.tf(link)


def _frames(types: Types, recipe: Recipe, end: float) -> Iterator[Entry]:
    if recipe.republished:
        for t in np.arange(0.0, end, 0.1).tolist():
            yield t, "/tf", types.links(recipe.start + t, recipe.static)
    elif recipe.static:
        yield 0.0, "/tf_static", types.links(recipe.start, recipe.static)
    if recipe.clock:
        for t in np.arange(0.0, end, 0.1).tolist():
            yield t, "/clock", types.new("rosgraph_msgs/msg/Clock", types.time(recipe.start + t))


def write(path: Path, recipe: Recipe, entries: Sequence[Entry]) -> Path:
    """Write a bag; what is logged comes 1 ms after it happened, on the wall clock."""
    types = Types(recipe.ros1, recipe.tf_type)
    if recipe.ros1:
        writer: Any = Writer1(path)
        if recipe.compression is not CompressionMode.NONE:
            writer.set_compression(Writer1.CompressionFormat.LZ4)
    else:
        writer = Writer2(path, version=9, storage_plugin=recipe.plugin)
        if recipe.compression is not CompressionMode.NONE:
            writer.set_compression(recipe.compression, CompressionFormat.ZSTD)
    begin = 1_700_000_000.0
    with writer:
        known: dict[str, Any] = {}
        for t, topic, message in entries:
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=types.store)
            pack = types.store.serialize_ros1 if recipe.ros1 else types.store.serialize_cdr
            writer.write(known[topic], round((begin + t + 1e-3) * 1e9), bytes(pack(message, kind)))
    return path
