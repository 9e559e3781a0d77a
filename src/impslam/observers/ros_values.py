"""A map as ROS 2 messages: grid, path, frames and health (REP 103, 105)."""

from __future__ import annotations

import numpy as np

from impslam.health import STATES, describe, state_of
from impslam.maps.files import MapImage
from impslam.observers.grid_picture import occupancy
from impslam.sources.ros_build import header_of, new, planar, time_of, turn, xyz
from impslam.sources.ros_storage import RosMessage
from impslam.types import Array


def grid(image: MapImage, stamp: float) -> RosMessage:
    """Return the grid as `nav_msgs/OccupancyGrid`."""
    rows, columns = image.pixels.shape
    origin = planar(np.array([*image.origin, 0.0]))
    facts = (time_of(stamp), image.resolution, columns, rows, origin)
    metadata = new("nav_msgs/msg/MapMetaData", *facts)
    bottom_up = occupancy(image)[::-1].reshape(-1)
    return new("nav_msgs/msg/OccupancyGrid", header_of(stamp, "map"), metadata, bottom_up)


def path(stamps: Array, poses: Array) -> RosMessage:
    """Return poses (n, 3) in map as `nav_msgs/Path`."""
    rows = [
        new("geometry_msgs/msg/PoseStamped", header_of(float(stamp), "map"), planar(pose))
        for stamp, pose in zip(stamps, poses, strict=True)
    ]
    return new("nav_msgs/msg/Path", header_of(float(stamps[0]), "map"), rows)


def frames(stamp: float, T_map_odom: Array, T_odom_base: Array) -> RosMessage:
    """Return two poses (3,) m, m, rad, map -> odom -> base_link, as `tf2_msgs/TFMessage`; stamp in s."""
    pairs = (("map", "odom", T_map_odom), ("odom", "base_link", T_odom_base))
    return new("tf2_msgs/msg/TFMessage", [_frame(stamp, *pair) for pair in pairs])


def _frame(stamp: float, parent: str, child: str, pose: Array) -> RosMessage:
    x, y, theta = map(float, pose)
    T = new("geometry_msgs/msg/Transform", xyz("Vector3", np.array([x, y, 0.0])), turn(theta))
    return new("geometry_msgs/msg/TransformStamped", header_of(stamp, parent), child, T)


def health(stamp: float, reason: int, amount: float) -> RosMessage:
    """Return whether a pose can be trusted as `diagnostic_msgs/DiagnosticArray`.

    TRACKING is OK, DEGRADED a warning, LOST an error; the message is the reason.
    """
    state = state_of(reason)
    text = ": ".join(filter(None, (STATES[state], describe(reason, amount))))
    status = new("diagnostic_msgs/msg/DiagnosticStatus", state, "impslam: pose", text, "", [])
    return new("diagnostic_msgs/msg/DiagnosticArray", header_of(stamp, ""), [status])
