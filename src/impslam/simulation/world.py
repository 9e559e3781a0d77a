"""Worlds in TOML: walls, objects, doors and people, and the robot's drive.

Lengths are in m, times in s since the start of the run, angles in rad, all in the map frame. The free space
is on the left of a wall from start to end; "behind the wall" is on its right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from impslam import toml
from impslam.component import near_miss
from impslam.errors import ConfigError
from impslam.parameters import Parameters, parameter
from impslam.paths import read_text
from impslam.types import Array, TrueLandmark

Finite = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite]
Pose = tuple[Finite, Finite, Finite]
Span = tuple[float, float]
Size = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Part(Parameters):
    """A table of a world file; unknown keys are errors."""


class Wall(Part):
    """A straight wall with the free space on the left of start -> end; doors cut holes into it."""

    name: str = parameter("", "", "landmark name; walls without one are not landmarks")
    start: Point
    end: Point

    @property
    def length(self) -> float:
        """Length in m."""
        return math.dist(self.start, self.end)

    @property
    def direction(self) -> Array:
        """Unit vector (2,) along the wall."""
        return np.subtract(self.end, self.start) / self.length

    @property
    def outward(self) -> Array:
        """Unit normal (2,) into the wall, away from the free space."""
        along = self.direction
        return np.array([along[1], -along[0]])


class Cylinder(Part):
    """An upright cylinder: a traffic cone, a pillar, a bin."""

    name: str = parameter("", "", "landmark name; cylinders without one are clutter")
    centre: Point
    radius: float = parameter(..., "m", "radius", gt=0.0)


class Box(Part):
    """A rectangular piece of clutter."""

    centre: Point
    size: tuple[Size, Size]
    angle: Finite = parameter(0.0, "rad", "turned by this, counter-clockwise")


class Door(Part):
    """A door in a wall, set back from its face, that swings away from the free space."""

    wall: str = parameter(..., "", "name of its wall")
    at: float = parameter(..., "m", "distance of its hinge from the wall's start", ge=0.0)
    width: float = parameter(0.9, "m", "width of the opening", gt=0.0)
    recess: float = parameter(0.07, "m", "depth of the jambs: leaf behind wall face", ge=0.0)
    open: tuple[Span, ...] = parameter(
        (), "s", "times [from, until] at which it is open; inf: for ever", special="inf -inf"
    )
    swing: float = parameter(math.pi / 2, "rad", "angle of the open leaf", gt=0.0, le=math.pi)
    swing_time: float = parameter(1.5, "s", "time to open or to close", gt=0.0)
    room: tuple[Size, Size] | None = parameter(
        None, "m", "width and depth of the room behind it; default: no room"
    )

    def angle(self, time: float) -> float:
        """Return the opening angle of the leaf at a time, rad."""
        part = max((self._openness(span, time) for span in self.open), default=0.0)
        return part * self.swing

    def _openness(self, span: Span, time: float) -> float:
        opening = (time - span[0]) / self.swing_time
        closing = 1.0 - (time - span[1]) / self.swing_time
        return min(max(min(opening, closing), 0.0), 1.0)


class Person(Part):
    """A person who walks along waypoints on two legs, and stands still before and after."""

    waypoints: tuple[Point, ...] = parameter(..., "m", "the path", min_length=2)
    start: float = parameter(0.0, "s", "start of the walk", ge=0.0)
    speed: float = parameter(1.2, "m/s", "walking speed", gt=0.0)
    returns: bool = parameter(False, "", "walk back and forth for ever")
    leg_radius: float = parameter(0.06, "m", "radius of a leg at the lidar's height", gt=0.0)
    leg_spacing: float = parameter(0.2, "m", "sideways distance between the legs", ge=0.0)
    stride: float = parameter(1.3, "m", "distance between two steps of the same foot", gt=0.0)


class Drive(Part):
    """The robot's start, path and dynamics."""

    start: Pose = parameter((0.0, 0.0, 0.0), "m, m, rad", "pose at the start")
    waypoints: tuple[Point, ...] = parameter(..., "m", "the path after the start", min_length=1)
    speed: float = parameter(0.25, "m/s", "cruise speed", gt=0.0)
    acceleration: float = parameter(0.5, "m/s^2", "speeding up and braking", gt=0.0)
    turn_rate: float = parameter(0.8, "rad/s", "maximum turn rate", gt=0.0)
    turn_acceleration: float = parameter(4.0, "rad/s^2", "change of the turn rate", gt=0.0)
    lookahead: float = parameter(
        0.25, "m", "distance of the aim point; cuts corners by this", gt=0.0
    )
    radius: float = parameter(0.25, "m", "radius of the robot's outline", gt=0.0)
    rest: float = parameter(1.0, "s", "time at rest before and after the drive", ge=0.0)
    limit: float = parameter(math.inf, "s", "maximum duration of the run", ge=1.0)


class World(Part):
    """A world file."""

    name: str = ""
    description: str = ""
    robot: Drive
    walls: tuple[Wall, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    boxes: tuple[Box, ...] = ()
    doors: tuple[Door, ...] = ()
    people: tuple[Person, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        for problem in self._problems():
            raise ValueError(problem)
        return self

    def _problems(self) -> Iterator[str]:
        """Yield each problem as one line."""
        names = [wall.name for wall in self.walls] + [c.name for c in self.cylinders]
        duplicates = sorted({name for name in names if name and names.count(name) > 1})
        yield from (f"the name {name!r} is given twice; rename one" for name in duplicates)
        for number, wall in enumerate(self.walls):
            if wall.length == 0.0:
                yield f"walls.{number}: start and end are the same point; move one"
        yield from _repeated_points("robot", (self.robot.start[:2], *self.robot.waypoints))
        for number, person in enumerate(self.people):
            yield from _repeated_points(f"people.{number}", person.waypoints)
        yield from self._door_problems()

    def _door_problems(self) -> Iterator[str]:
        known = {wall.name: wall for wall in self.walls if wall.name}
        taken: dict[str, list[tuple[float, float]]] = {}
        for number, door in enumerate(self.doors):
            where, end = f"doors.{number}", door.at + door.width
            if door.wall not in known:
                yield f"{where}: no wall named {door.wall!r}; {near_miss(door.wall, known)}"
                continue
            if end > known[door.wall].length:
                yield f"{where}: extends beyond the end of wall {door.wall!r}; move it"
            others = taken.setdefault(door.wall, [])
            if any(door.at < other[1] and other[0] < end for other in others):
                yield f"{where}: overlaps another door in wall {door.wall!r}; move it"
            others.append((door.at, end))
            if any(not span[0] < span[1] for span in door.open):
                yield f"{where}.open: each entry is [from, until] with from < until; swap them"

    def landmarks(self) -> list[TrueLandmark]:
        """Return the named walls and cylinders, for scoring maps."""
        return [*self._true_walls(), *self._true_cylinders()]

    def _true_cylinders(self) -> Iterator[TrueLandmark]:
        for part in self.cylinders:
            if part.name:
                x, y = part.centre
                values = {"x": x, "y": y, "radius": part.radius}
                yield TrueLandmark(part.name, "cylinder", np.array([x, y]), values)

    def _true_walls(self) -> Iterator[TrueLandmark]:
        for wall in self.walls:
            if wall.name:
                foot = float(wall.outward @ wall.start) * wall.outward
                normal = wall.outward if not foot.any() else foot
                values = {
                    "r": math.hypot(*foot),
                    "alpha": math.atan2(normal[1], normal[0]),
                }
                ends = np.array([wall.start, wall.end])
                yield TrueLandmark(wall.name, "wall", foot, values, ends)


def _repeated_points(where: str, path: Sequence[tuple[float, float]]) -> Iterator[str]:
    for number, (a, b) in enumerate(pairwise(path)):
        if a == b:
            yield f"{where}: point {number} of the path is given twice in a row; remove one"


def shipped_worlds() -> list[str]:
    """Return the names of the worlds included in the package."""
    folder = files("impslam.simulation") / "worlds"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name[-5:] == ".toml")


def load_world(name_or_path: str | Path) -> World:
    """Load a world by the name of a shipped one ("arena") or from a TOML file.

    Raises
    ------
    ConfigError
        If there is no such world, or its file is not valid; the message names file and key.
    """
    name = str(name_or_path)
    if name in shipped_worlds():
        text = (files("impslam.simulation") / "worlds" / f"{name}.toml").read_text("utf-8")
        return parse_world(text, f"{name}.toml")
    path = Path(name_or_path)
    if not path.is_file():
        hint = near_miss(name, shipped_worlds())
        raise ConfigError(f"{name}: no such world or file; {hint}")
    return parse_world(read_text(path, "check the file", ConfigError), name)


def parse_world(text: str, where: str) -> World:
    """Parse a world from TOML text; `where` names it in errors."""
    table = toml.parse(text, where)
    table.setdefault("name", Path(where).stem)
    try:
        return World.model_validate(table)
    except ValidationError as error:
        raise ConfigError(_one_line(error, where)) from None


def _one_line(error: ValidationError, where: str) -> str:
    first = error.errors()[0]
    path = ".".join(str(part) for part in first["loc"])
    if first["type"] == "value_error" and not path:
        return f"{where}: {first['msg'].removeprefix('Value error, ')}"
    if first["type"] == "missing":
        return f"{where}: {path} is missing; add it"
    if first["type"] == "extra_forbidden":
        hint = near_miss(str(first["loc"][-1]), _keys(first["loc"][:-1]))
        return f"{where}: {path} is not a key of a world; {hint}"
    return f"{where}: {path} = {str(first['input'])[:60]}: {first['msg'].removeprefix('Value error, ')}"


def _keys(path: tuple[int | str, ...]) -> list[str]:
    """Return the valid keys of the table at a path of a world file."""
    tables: dict[str, type[Part]] = {
        "robot": Drive,
        "walls": Wall,
        "cylinders": Cylinder,
        "boxes": Box,
        "doors": Door,
        "people": Person,
    }
    model: Any = tables.get(str(path[0]), World) if path else World
    return list(model.model_fields)
