"""A map as ROS 2 messages: grid, path, landmarks, frames and health (REP 103, 105)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from impslam.evaluation.colours import INK, POINT, SIGMAS, WALL
from impslam.health import STATES, state_of, words
from impslam.maps.files import MapImage
from impslam.observers.grid_picture import occupancy
from impslam.observers.map_picture import ellipse
from impslam.sources.ros_storage import RosMessage
from impslam.sources.ros_writers import header_of, new, planar, time_of, turn, xyz
from impslam.types import Array, Landmark

HEIGHT = 0.5
"""m, of the columns and letters that mark landmarks: a map in the plane tells none."""
THIN = 0.05
"""m, width of lines."""
CYLINDER, LINE_STRIP, LETTERS = 3, 4, 9
"""Kinds of visualization_msgs/Marker."""


def grid(image: MapImage, stamp: float) -> RosMessage:
    """Return the grid as `nav_msgs/OccupancyGrid`."""
    rows, columns = image.pixels.shape
    origin = planar(np.array([*image.origin, 0.0]))
    facts = (time_of(stamp), image.resolution, columns, rows, origin)
    about = new("nav_msgs/msg/MapMetaData", *facts)
    lowest_first = occupancy(image)[::-1].reshape(-1)
    return new("nav_msgs/msg/OccupancyGrid", header_of(stamp, "map"), about, lowest_first)


def path(stamps: Array, poses: Array) -> RosMessage:
    """Return poses (n, 3) in map as `nav_msgs/Path`."""
    rows = [
        new("geometry_msgs/msg/PoseStamped", header_of(float(stamp), "map"), planar(pose))
        for stamp, pose in zip(stamps, poses, strict=True)
    ]
    return new("nav_msgs/msg/Path", header_of(float(stamps[0]), "map"), rows)


def frames(stamp: float, T_map_odom: Array, T_odom_base: Array) -> RosMessage:
    """Return map -> odom -> base_link as `tf2_msgs/TFMessage`."""
    pairs = (("map", "odom", T_map_odom), ("odom", "base_link", T_odom_base))
    return new("tf2_msgs/msg/TFMessage", [_frame(stamp, *pair) for pair in pairs])


def _frame(stamp: float, parent: str, child: str, pose: Array) -> RosMessage:
    x, y, theta = map(float, pose)
    moved = new("geometry_msgs/msg/Transform", xyz("Vector3", np.array([x, y, 0.0])), turn(theta))
    return new("geometry_msgs/msg/TransformStamped", header_of(stamp, parent), child, moved)


def health(stamp: float, reason: int, amount: float) -> RosMessage:
    """Return whether a pose can be trusted as `diagnostic_msgs/DiagnosticArray`.

    TRACKING is OK, DEGRADED a warning, LOST an error; the message is the reason.
    """
    state = state_of(reason)
    said = ": ".join(filter(None, (STATES[state], words(reason, amount))))
    status = new("diagnostic_msgs/msg/DiagnosticStatus", state, "impslam: pose", said, "", [])
    return new("diagnostic_msgs/msg/DiagnosticArray", header_of(stamp, ""), [status])


def landmarks(marks: Sequence[Landmark], stamp: float) -> RosMessage:
    """Return landmarks, their ellipses and their numbers as `visualization_msgs/MarkerArray`."""
    markers = [marker for mark in marks for marker in _markers(mark, stamp)]
    return new("visualization_msgs/msg/MarkerArray", markers)


def _markers(mark: Landmark, stamp: float) -> Iterator[RosMessage]:
    if mark.end_points is None:
        width, at = 2.0 * max(mark.parameters.get("radius", 0.0), THIN), mark.position
        yield _marker(
            mark.id, mark.kind, stamp, CYLINDER, POINT, at=at, scale=(width, width, HEIGHT)
        )
        around = ellipse(mark)
        name = f"{SIGMAS:.0f} sigma"
        yield _marker(mark.id, name, stamp, LINE_STRIP, POINT, line=np.vstack((around, around[:1])))
    else:
        at = mark.end_points.mean(axis=0)
        yield _marker(mark.id, mark.kind, stamp, LINE_STRIP, WALL, line=mark.end_points)
    scale = (0.0, 0.0, 0.5 * HEIGHT)
    yield _marker(mark.id, "number", stamp, LETTERS, INK, at=at, scale=scale, text=str(mark.id))


def _marker(  # noqa: PLR0913  # as many as the message has that matter
    number: int,
    space: str,
    stamp: float,
    kind: int,
    code: str,
    *,
    at: Array | None = None,
    scale: tuple[float, float, float] = (THIN, 0.0, 0.0),
    line: Sequence[Array] | Array = (),
    text: str = "",
) -> RosMessage:
    """Return a marker in map; one with a line (n, 2) m lies at the origin."""
    x, y = (0.0, 0.0) if at is None else map(float, at)
    place = new(
        "geometry_msgs/msg/Pose",
        xyz("Point", np.array([x, y, 0.5 * HEIGHT * (at is not None)])),
        turn(0.0),
    )
    red, green, blue = (channel / 255.0 for channel in bytes.fromhex(code.removeprefix("#")))
    return new(
        "visualization_msgs/msg/Marker",
        *(header_of(stamp, "map"), space, number, kind, 0, place),
        *(xyz("Vector3", np.array(scale)), new("std_msgs/msg/ColorRGBA", red, green, blue, 0.8)),
        *(new("builtin_interfaces/msg/Duration", 0, 0), False),
        [xyz("Point", np.array([*point, 0.0])) for point in line],
        *(
            [],
            "",
            new("sensor_msgs/msg/CompressedImage", header_of(0.0, ""), "", np.empty(0, np.uint8)),
        ),
        *([], text, "", new("visualization_msgs/msg/MeshFile", "", np.empty(0, np.uint8)), False),
    )
