"""Chooses what the topics of a ROS log are used for."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

from rosbags.interfaces import Connection

from impslam.component import near_miss
from impslam.errors import SourceError
from impslam.types import (
    Image,
    Imu,
    LaserScan,
    Message,
    OdometryPose,
    SatelliteFix,
    TruePose,
    Velocity,
    WheelAngles,
)

Use: TypeAlias = Literal[
    "scan", "wheels", "voltages", "velocity", "odometry", "imu", "fix", "image", "truth"
]

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
TWIST_TYPES = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped")
POSE_TYPES = (
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)
"""Odometry or truth only if the user names the topic: most of these poses are goals, or poses in a map."""
TYPES: dict[Use, tuple[str, ...]] = {
    "truth": (ODOMETRY_TYPE, *POSE_TYPES),
    "scan": ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"),
    "wheels": ("sensor_msgs/msg/JointState",),
    "voltages": ("geometry_msgs/msg/Vector3Stamped",),
    "velocity": (*TWIST_TYPES, ODOMETRY_TYPE),
    "odometry": (ODOMETRY_TYPE, *TF_TYPES, *POSE_TYPES),
    "imu": ("sensor_msgs/msg/Imu",),
    "fix": ("sensor_msgs/msg/NavSatFix",),
    "image": ("sensor_msgs/msg/CompressedImage",),
}
"""The message types for each use, in order of preference."""
KINDS: dict[Use, type[Message]] = {
    "truth": TruePose,
    "scan": LaserScan,
    "wheels": WheelAngles,
    "voltages": WheelAngles,
    "velocity": Velocity,
    "odometry": OdometryPose,
    "imu": Imu,
    "fix": SatelliteFix,
    "image": Image,
}
TRUTH_TOPIC = "ground_truth"  # in its name; Stage has /base_pose_ground_truth
ONLY_BY_NAME: tuple[Use, ...] = ("voltages", "velocity")
"""Uses whose message type is generic (velocities may be commands): only topics that the user names have
them."""
COMMAND = "cmd"  # in the names of topics of commanded velocities
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
MAKE_SCANS = "make a LaserScan of it with the ROS package pointcloud_to_laserscan"
EVENT_TYPE = "rcl_interfaces/msg/Log"

KEPT = {
    EVENT_TYPE: "events",
    "sensor_msgs/msg/TimeReference": "a device's clock",
    "sensor_msgs/msg/MagneticField": "magnetic field",
    "sensor_msgs/msg/Temperature": "temperature",
    "sensor_msgs/msg/RelativeHumidity": "humidity",
    "geometry_msgs/msg/AccelStamped": "second accelerometer",
    "geometry_msgs/msg/Vector3Stamped": "encoder voltages",
    "geometry_msgs/msg/TwistStamped": "commanded velocity",
}
"""Further types written by the robot's recorder; mapping does not use them."""

Counts: TypeAlias = dict[tuple[str, str], int]
"""Number of messages by (topic, type)."""


def choose(
    log: Path, requested: Mapping[Use, str], counts: Counts, merged: Collection[str] = ()
) -> dict[str, Use]:
    """Return what each topic is used for: the requested topics, then the best for each other use.

    The best one has the first type in `TYPES`, then the most messages; for odometry, topics in the same
    namespace as the scans and those named odom (REP 105) are preferred. Topics named scan are preferred to
    those with up to twice the messages: nodes that filter scans publish them under other names. Scans in
    `merged` come last: their beams are from several lidars, at times that are lost.
    """
    uses: dict[str, Use] = {}
    for use, topic in requested.items():
        if topic:
            _check(log, use, topic, counts)
            uses[topic] = use
    for use, kinds in TYPES.items():
        if use in requested or use in ONLY_BY_NAME:
            continue
        scan = next((topic for topic, name in uses.items() if name == "scan"), "")
        free = [
            (kinds.index(k), t, n)
            for (t, k), n in counts.items()
            if k in kinds and n and k not in POSE_TYPES
        ]
        most = max((n for _, _, n in free), default=0)
        fit = [
            (kind, topic in merged, _unlikely(use, topic, scan, 2 * n >= most), -n, topic)
            for kind, topic, n in free
            if topic not in uses and is_truth(topic) == (use == "truth")
        ]
        if fit:
            uses[min(fit)[-1]] = use
    return uses


def _unlikely(use: Use, topic: str, scan: str, is_frequent: bool) -> tuple[bool, bool]:
    """Return whether a topic is in an unlikely namespace, and whether it has an unlikely name.

    The namespace of odometry is that of the scans. Usual names are scan, if it is frequent, and odom.
    """
    name = topic.rsplit("/", 1)[-1]
    if use == "scan":
        return False, not (name == "scan" and is_frequent)
    if use == "odometry":
        return namespace(topic) != namespace(scan), name != "odom"
    return False, False


def namespace(topic: str) -> str:
    """Return the namespace of a robot that a topic begins with, "" if it has none."""
    return "/".join(topic.split("/")[:2]) if topic.count("/") > 1 else ""


def choose_wanted(wanted: Collection[str], counts: Counts) -> dict[str, Use]:
    """Return what the topics named in `wanted` are used for."""
    uses: dict[str, Use] = {}
    for topic, kind in counts:
        fit = [use for use, kinds in TYPES.items() if kind in kinds]
        if topic in wanted and fit:
            uses[topic] = "truth" if "truth" in fit and is_truth(topic) else fit[-1]
    return uses


def _check(log: Path, use: Use, topic: str, counts: Counts) -> None:
    if not any((topic, kind) in counts for kind in TYPES[use]):
        known = [name for name, kind in counts if kind in TYPES[use]]
        raise SourceError(
            f"{log}: no topic {topic!r} of type {TYPES[use][0]} for source.topics.{use}; "
            + (near_miss(topic, known) if known else "the log has none of this type")
        )


def rival_note(topic: str, kind: str, defaults: Mapping[str, Use]) -> str:
    """Return why a topic is not read, and how to read it; or ""."""
    if kind == CLOUD_TYPE:
        return f"not read: {MAKE_SCANS}"
    if kind in POSE_TYPES:
        return ""
    uses = [use for use, kinds in TYPES.items() if kind in kinds]
    taken = {use: name for name, use in defaults.items() if use in uses}
    if not taken:
        return ""
    chosen = ", ".join(f"{use} is {name}" for use, name in taken.items())
    return (
        f"not read: {chosen}; set source.topics.{next(iter(taken))}={topic} to use this one "
        "instead, or name it in source.wanted"
    )


def count_messages(connections: Sequence[Connection]) -> Counts:
    """Return the number of messages by (topic, type)."""
    counts: dict[tuple[str, str], int] = defaultdict(int)
    for connection in connections:
        counts[connection.topic, connection.msgtype] += connection.msgcount
    return dict(counts)


def is_truth(topic: str) -> bool:
    """Return whether an odometry topic contains ground truth, judging by its name."""
    return TRUTH_TOPIC in topic
