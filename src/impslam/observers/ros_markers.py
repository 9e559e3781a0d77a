"""Landmarks as ROS 2 markers, which RViz and Foxglove show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from impslam.evaluation.colours import INK, POINT, SIGMAS, WALL
from impslam.observers.map_picture import ellipse
from impslam.sources.ros_build import header_of, new, turn, xyz
from impslam.sources.ros_storage import RosMessage
from impslam.types import Array, Landmark

HEIGHT = 0.5
"""m, of the columns and letters that mark landmarks: a map in the plane tells none."""
THIN = 0.05
"""m, width of lines."""
CYLINDER, LINE_STRIP, LETTERS = 3, 4, 9
"""Kinds of visualization_msgs/Marker."""


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
