"""Landmarks as ROS 2 markers for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from impslam.evaluation.colours import INK, POINT, SIGMAS, WALL
from impslam.observers.map_picture import ellipse
from impslam.sources.ros_build import header_of, new, turn, xyz
from impslam.sources.ros_storage import RosMessage
from impslam.types import Array, Landmark

HEIGHT = 0.5
"""Height of the markers, m; landmarks of a 2D map have none."""
LINE_WIDTH = 0.05  # m
CYLINDER, LINE_STRIP, TEXT = 3, 4, 9
"""Types of visualization_msgs/Marker."""


def landmarks(marks: Sequence[Landmark], stamp: float) -> RosMessage:
    """Return landmarks, their ellipses and their numbers as `visualization_msgs/MarkerArray`."""
    markers = [marker for mark in marks for marker in _markers(mark, stamp)]
    return new("visualization_msgs/msg/MarkerArray", markers)


def _markers(mark: Landmark, stamp: float) -> Iterator[RosMessage]:
    if mark.end_points is None:
        width, at = 2.0 * max(mark.parameters.get("radius", 0.0), LINE_WIDTH), mark.position
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
    yield _marker(mark.id, "number", stamp, TEXT, INK, at=at, scale=scale, text=str(mark.id))


def _marker(  # noqa: PLR0913  # the fields of the message that matter
    number: int,
    space: str,
    stamp: float,
    kind: int,
    code: str,
    *,
    at: Array | None = None,
    scale: tuple[float, float, float] = (LINE_WIDTH, 0.0, 0.0),
    line: Sequence[Array] | Array = (),
    text: str = "",
) -> RosMessage:
    """Return a marker in map; a line (n, 2) m is relative to the origin."""
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
