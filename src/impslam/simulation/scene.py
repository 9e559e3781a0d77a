"""A world as the lidar meets it: segments and circles, standing and moving."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from impslam.geometry.se2 import rotation
from impslam.simulation.world import Box, Door, Person, Wall, World
from impslam.types import Array


@dataclass(frozen=True)
class Scene:
    """Geometry of a world at any time."""

    world: World

    @cached_property
    def segments(self) -> Array:
        """Everything straight that stands: walls with their doorways, boxes; (s, 4) m."""
        rows: list[Array] = []
        for wall in self.world.walls:
            doors = [door for door in self.world.doors if wall.name and door.wall == wall.name]
            rows += _pierced(wall, doors)
        for box in self.world.boxes:
            rows += _outline(box)
        return np.array(rows).reshape(-1, 4)

    @cached_property
    def circles(self) -> Array:
        """Everything round that stands; (c, 3) m."""
        rows = [(*part.centre, part.radius) for part in self.world.cylinders]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def near(self, centre: Array, reach: float) -> tuple[Array, Array]:
        """Return the standing segments and circles that come within reach of a point (2,)."""
        close = distance_to_segments(centre, self.segments) <= reach
        gap = np.hypot(*(self.circles[:, :2] - centre).T) - self.circles[:, 2]
        return self.segments[close], self.circles[gap <= reach]

    def leaves(self, time: float) -> Array:
        """Return the doors' leaves at a time; (m, 4) m."""
        walls = {wall.name: wall for wall in self.world.walls}
        rows = [_leaf(walls[door.wall], door, time) for door in self.world.doors]
        return np.array(rows).reshape(-1, 4)

    def legs(self, time: float) -> Array:
        """Return the people's legs at a time; (k, 3) m."""
        rows = [leg for person in self.world.people for leg in _legs(person, time)]
        return np.array(rows).reshape(-1, 3)

    def moving(self, begin: float, end: float) -> tuple[Array, Array]:
        """Return leaves (2, m, 4) and legs (2, k, 3) at two times."""
        return (
            np.stack([self.leaves(begin), self.leaves(end)]),
            np.stack([self.legs(begin), self.legs(end)]),
        )

    def clearance(self, point: Array, time: float) -> float:
        """Return the distance from a point (2,) to the nearest thing at a time, in m."""
        segments = np.vstack([self.segments, self.leaves(time)])
        circles = np.vstack([self.circles, self.legs(time)])
        gaps = np.hypot(*(circles[:, :2] - point).T) - circles[:, 2]
        return float(np.hstack([distance_to_segments(point, segments), gaps, math.inf]).min())


def distance_to_segments(point: Array, segments: Array) -> Array:
    """Return the distance of a point (2,) from each of the segments (s, 4), in m."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    square = np.maximum((along**2).sum(1), np.finfo(float).tiny)
    part = np.clip(((point - start) * along).sum(1) / square, 0.0, 1.0)
    return np.asarray(np.hypot(*(start + part[:, None] * along - point).T))


def _pierced(wall: Wall, doors: Sequence[Door]) -> list[Array]:
    """Return the pieces of a wall between its doors, and what is seen of the doorways."""
    rows: list[Array] = []
    begin = 0.0
    for door in sorted(doors, key=lambda door: door.at):
        rows.append(_piece(wall, (begin, 0.0), (door.at, 0.0)))
        rows += _doorway(wall, door)
        begin = door.at + door.width
    return [*rows, _piece(wall, (begin, 0.0), (wall.length, 0.0))]


def _doorway(wall: Wall, door: Door) -> list[Array]:
    """Return both jambs and, if there is one, the room behind."""
    left, right, depth = door.at, door.at + door.width, door.recess
    corners = [[(left, 0.0), (left, depth)], [(right, 0.0), (right, depth)]]
    if door.room is not None:
        middle, half = 0.5 * (left + right), 0.5 * door.room[0]
        west, east, back = middle - half, middle + half, depth + door.room[1]
        corners.append([(left, depth), (west, depth), (west, back), (east, back)])
        corners[-1] += [(east, depth), (right, depth)]
    return [_piece(wall, a, b) for line in corners for a, b in pairwise(line)]


def _piece(wall: Wall, a: tuple[float, float], b: tuple[float, float]) -> Array:
    """Return the segment between two points given as (along, behind) the wall."""
    axes = np.array([wall.direction, wall.outward])
    return np.concatenate([wall.start + np.array(a) @ axes, wall.start + np.array(b) @ axes])


def _leaf(wall: Wall, door: Door, time: float) -> Array:
    angle = door.angle(time)
    tip = (
        door.at + door.width * math.cos(angle),
        door.recess + door.width * math.sin(angle),
    )
    return _piece(wall, (door.at, door.recess), tip)


def _outline(box: Box) -> list[Array]:
    half = 0.5 * np.array(box.size)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    placed = corners @ rotation(box.angle).T + box.centre
    return [np.concatenate([placed[i], placed[(i + 1) % 4]]) for i in range(4)]


def _legs(person: Person, time: float) -> list[tuple[float, float, float]]:
    """Return both legs [x, y, radius] of a person at a time.

    A foot's way is s + stride / 2 pi sin(2 pi s / stride): at rest once a stride, twice as fast as
    the body in between; the other foot is half a stride behind.
    """
    way = np.array(person.waypoints)
    length = float(np.hypot(*np.diff(way, axis=0).T).sum())
    walked = person.speed * max(time - person.start, 0.0)
    lap = int(walked // length) if person.returns else 0
    on_lap = min(walked - lap * length, length)
    rows = []
    for side, phase in ((1.0, 0.0), (-1.0, math.pi)):
        swing = math.sin(2 * math.pi * on_lap / person.stride + phase)
        # Both feet come to stand side by side where the way ends.
        fade = min(1.0, on_lap / person.stride, (length - on_lap) / person.stride)
        foot = on_lap + fade * person.stride / (2 * math.pi) * swing
        back = lap % 2 == 1
        place, across = _along(way, length - foot if back else foot)
        sideways = (-side if back else side) * 0.5 * person.leg_spacing
        x, y = place + sideways * across
        rows.append((float(x), float(y), person.leg_radius))
    return rows


def _along(way: Array, distance: float) -> tuple[Array, Array]:
    """Return the point (2,) at a distance along a polyline (n, 2), and the unit normal there."""
    steps = np.diff(way, axis=0)
    lengths = np.hypot(*steps.T)
    ends = np.cumsum(lengths)
    i = min(int(np.searchsorted(ends, distance)), len(lengths) - 1)
    direction = steps[i] / lengths[i]
    place = way[i + 1] - (ends[i] - distance) * direction
    return place, np.array([-direction[1], direction[0]])
