"""What in a ROS log may be odometry, but is not read as such: joints, velocities and poses."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import NamedTuple

from rosbags.interfaces import Connection

from impslam.sources.ros_messages import find_joints
from impslam.sources.ros_storage import Bag
from impslam.sources.ros_topics import COMMAND, POSE_TYPES, TWIST_TYPES, count_messages

MAX_JOINT_MESSAGES = 200
"""Messages among which all publishers of joints occur: rates of two differ by a factor of 100 at most."""
NAME_WHEELS = "name them with --set source.left_joint=NAME --set source.right_joint=NAME"
NO_POSITIONS = "its wheels have velocities, but no positions, which odometry needs"


class JointFault(NamedTuple):
    """Why the joints of a topic are no odometry, and whether some are wheels by their names."""

    text: str
    has_wheels: bool


def joint_fault(bag: Bag, topic: str, joints: tuple[str, str]) -> JointFault | None:
    """Return why the joints of a topic are no odometry; None if they are, or if none can be read.

    Several programs may publish joints on one topic, each its own: wheels, and an arm. `joints` are the
    names of the wheels, or empty.
    """
    names, has_wheels = dict[str, None](), False
    connections = [c for c in bag.connections if c.topic == topic]
    with suppress(Exception):  # rosbags may raise anything on damaged data
        for connection, _, data in islice(bag.messages(connections), MAX_JOINT_MESSAGES):
            with suppress(Exception):
                message = bag.decoder(connection)(data)
                found = find_joints(message.name, *joints)
                if found is not None and max(found) < len(message.position):
                    return None
                has_wheels |= found is not None
                names |= dict.fromkeys(message.name)
    if has_wheels:
        return JointFault(NO_POSITIONS, True)
    if not names:
        return None
    text = f"no wheels among the joints {', '.join(names)}; {NAME_WHEELS}"
    return JointFault(text, any("wheel" in name.lower() for name in names))


def unread_motion(bag: Bag, faults: Mapping[str, JointFault], used: Collection[str]) -> str:
    """Describe the topics of wheels, velocities and poses that are not used.

    `faults` are those of joints, by topic.
    """
    connections = [c for c in bag.connections if c.topic not in used]
    wheels = (f"{t} is not read: {fault.text}" for t, fault in faults.items() if fault.has_wheels)
    return "; ".join([*wheels, *_velocities(connections), *_poses(connections)])


def _poses(connections: Sequence[Connection]) -> Iterator[str]:
    for (topic, kind), count in sorted(count_messages(connections).items()):
        if kind in POSE_TYPES and count > 1:  # a single one is a goal, or the start in a map
            yield (
                f"{topic} is not read: if these poses are odometry, not poses in a map, use them with "
                f"--topic odometry={topic}; to compare the path with them, --topic truth={topic}"
            )


def _velocities(connections: Sequence[Connection]) -> Iterator[str]:
    for (topic, kind), count in sorted(count_messages(connections).items()):
        if kind in TWIST_TYPES and count and COMMAND not in topic:
            yield (
                f"{topic} is not read: if these velocities are measured, not commanded, use them with "
                f"--topic velocity={topic}"
            )
