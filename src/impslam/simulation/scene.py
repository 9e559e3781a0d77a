"""The geometry of a world for the lidar: static and moving segments and circles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from impslam.geometry.se2 import rotation
from impslam.simulation.walk import PersonWalk
from impslam.simulation.world import Box, Door, Wall, World
from impslam.types import Array


class Thing(NamedTuple):
    """An object that a beam can hit.

    Attributes
    ----------
    kind : "wall", "doorway" (a jamb), "room" (behind a door), "door" (its leaf), "box", "cylinder"
        or "person" (a leg)
    part : index of the world's wall, door, box, ... that it belongs to
    """

    kind: str
    part: int


Straight = tuple[Thing, Array]


@dataclass(frozen=True)
class Scene:
    """Geometry of a world at any time."""

    world: World

    @cached_property
    def segments(self) -> Array:
        """Static segments of walls, doorways, doors that never open, and boxes; (s, 4) m."""
        return np.array([row for _, row in self._straight]).reshape(-1, 4)

    @cached_property
    def things(self) -> tuple[Thing, ...]:
        """All objects, in the order of `segments`, `circles`, `leaves` and `legs`."""
        world = self.world
        return (
            *(thing for thing, _ in self._straight),
            *(Thing("cylinder", number) for number in range(len(world.cylinders))),
            *(Thing("door", number) for number, door in enumerate(world.doors) if door.open),
            *(Thing("person", number) for number in range(len(world.people)) for _ in "lr"),
        )

    @cached_property
    def _straight(self) -> list[Straight]:
        rows = [
            (Thing("door", number), _leaf(wall, door, 0.0))
            for number, (wall, door) in enumerate(self._doors)
            if not door.open
        ]
        for number, wall in enumerate(self.world.walls):
            holes = [
                (k, door)
                for k, door in enumerate(self.world.doors)
                if wall.name and door.wall == wall.name
            ]
            rows += _wall_pieces(wall, number, holes)
        for number, box in enumerate(self.world.boxes):
            rows += [(Thing("box", number), row) for row in _outline(box)]
        return rows

    @cached_property
    def circles(self) -> Array:
        """Static circles: cylinders; (c, 3) m."""
        rows = [(*part.centre, part.radius) for part in self.world.cylinders]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def near(self, centre: Array, radius: float) -> tuple[Array, Array]:
        """Return the static segments and circles within a radius of a point (2,)."""
        close = distance_to_segments(centre, self.segments) <= radius
        gap = np.hypot(*(self.circles[:, :2] - centre).T) - self.circles[:, 2]
        return self.segments[close], self.circles[gap <= radius]

    def leaves(self, time: float) -> Array:
        """Return the leaves, at a time, of the doors that open at some time; (m, 4) m."""
        rows = [_leaf(wall, door, time) for wall, door in self._doors if door.open]
        return np.array(rows).reshape(-1, 4)

    def legs(self, time: float) -> Array:
        """Return the people's legs at a time; (k, 3) m."""
        rows = [leg for walk in self._walks for leg in walk.legs(time)]
        return np.array(rows).reshape(-1, 3)

    @cached_property
    def _doors(self) -> list[tuple[Wall, Door]]:
        walls = {wall.name: wall for wall in self.world.walls}
        return [(walls[door.wall], door) for door in self.world.doors]

    @cached_property
    def _walks(self) -> list[PersonWalk]:
        return [PersonWalk(person) for person in self.world.people]

    def moving(self, begin: float, end: float) -> tuple[Array, Array]:
        """Return leaves (2, m, 4) and legs (2, k, 3) at two times."""
        return (
            np.stack([self.leaves(begin), self.leaves(end)]),
            np.stack([self.legs(begin), self.legs(end)]),
        )

    def clearance(self, point: Array, time: float) -> float:
        """Return the distance from a point (2,) to the nearest object at a time, m."""
        segments = np.vstack([self.segments, self.leaves(time)])
        circles = np.vstack([self.circles, self.legs(time)])
        gaps = np.hypot(*(circles[:, :2] - point).T) - circles[:, 2]
        return float(np.hstack([distance_to_segments(point, segments), gaps, math.inf]).min())


def distance_to_segments(point: Array, segments: Array) -> Array:
    """Return the distance of a point (2,) from each of the segments (s, 4), m."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    square = np.maximum((along**2).sum(1), np.finfo(float).tiny)
    part = np.clip(((point - start) * along).sum(1) / square, 0.0, 1.0)
    return np.asarray(np.hypot(*(start + part[:, None] * along - point).T))


def _wall_pieces(wall: Wall, number: int, holes: Sequence[tuple[int, Door]]) -> list[Straight]:
    """Return the pieces of a wall between its doors, and the segments of its doorways."""
    rows: list[Straight] = []
    begin, thing = 0.0, Thing("wall", number)
    for k, door in sorted(holes, key=lambda hole: hole[1].at):
        rows.append((thing, _piece(wall, (begin, 0.0), (door.at, 0.0))))
        rows += _doorway(wall, door, k)
        begin = door.at + door.width
    return [*rows, (thing, _piece(wall, (begin, 0.0), (wall.length, 0.0)))]


def _doorway(wall: Wall, door: Door, number: int) -> list[Straight]:
    """Return both jambs and the walls of the room behind, if there is one."""
    left, right, depth = door.at, door.at + door.width, door.recess
    jambs = [[(left, 0.0), (left, depth)], [(right, 0.0), (right, depth)]]
    rows = [(Thing("doorway", number), _piece(wall, a, b)) for a, b in jambs]
    if door.room is not None:
        middle, half = 0.5 * (left + right), 0.5 * door.room[0]
        west, east, back = middle - half, middle + half, depth + door.room[1]
        corners = [(left, depth), (west, depth), (west, back), (east, back)]
        corners += [(east, depth), (right, depth)]
        rows += [(Thing("room", number), _piece(wall, a, b)) for a, b in pairwise(corners)]
    return rows


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
