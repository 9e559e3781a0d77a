"""What each beam hit: exact against geometry, in the order in which a scene lists its things."""

import math

import numpy as np
import pytest

from impslam.simulation.raycast import trace
from impslam.simulation.scene import Scene, distance_to_segments
from impslam.simulation.world import load_world

FRACTIONS = np.linspace(0.0, 1.0, 360)
ANGLES = np.linspace(-math.pi, math.pi, 360)


def things_at(scene, begin, end, fraction):
    """Return the rows of everything, in the order of `Scene.things`, at a part of a sweep."""
    leaves, legs = (
        moving[0] + fraction * (moving[1] - moving[0]) for moving in scene.moving(begin, end)
    )
    return [*scene.segments, *scene.circles, *leaves, *legs]


@pytest.mark.parametrize("world", ["arena", "room", "corridor"])
def test_every_row_has_a_thing(world):
    scene = Scene(load_world(world))
    rows = things_at(scene, 0.0, 1.0, 0.5)
    assert len(rows) == len(scene.things)
    for thing, row in zip(scene.things, rows, strict=True):
        assert (len(row) == 3) == (thing.kind in ("cylinder", "person"))


def test_a_thing_is_a_part_of_what_it_names():
    world = load_world("corridor")
    scene = Scene(world)
    for thing, row in zip(scene.things, things_at(scene, 0.0, 0.0, 0.0), strict=True):
        if thing.kind == "wall":
            whole = np.array([*world.walls[thing.part].start, *world.walls[thing.part].end])[None]
            assert distance_to_segments(row[:2], whole)[0] < 1e-9
            assert distance_to_segments(row[2:], whole)[0] < 1e-9
        elif thing.kind == "cylinder":
            assert tuple(row[:2]) == world.cylinders[thing.part].centre
        elif thing.kind == "box":
            half = 0.5 * math.hypot(*world.boxes[thing.part].size)
            assert math.dist(row[:2], world.boxes[thing.part].centre) == pytest.approx(half)
        elif thing.kind in ("door", "doorway"):
            door = world.doors[thing.part]
            wall = next(w for w in world.walls if w.name == door.wall)
            hinge = np.add(wall.start, door.at * wall.direction)
            assert math.dist(row[:2], hinge) <= door.width + door.recess + 1e-9
    assert {thing.kind for thing in scene.things} == {
        "wall", "doorway", "room", "door", "box", "cylinder", "person",
    }  # fmt: skip


@pytest.mark.parametrize("place", [(20.0, -0.3), (36.5, 0.0), (45.3, 4.0)])
def test_beams_end_on_what_they_hit_and_nowhere_else(place):
    """While people walk and doors swing: each beam against all things, at its own time."""
    scene = Scene(load_world("corridor"))
    lasers = np.tile([*place, 0.3], (len(ANGLES), 1))
    standing, moving = (scene.segments, scene.circles), scene.moving(38.5, 39.5)
    ranges, _, hits = trace(lasers, ANGLES, FRACTIONS, standing, moving, 5.6)
    assert (np.isinf(ranges) == (hits < 0)).all()
    for i in np.flatnonzero(hits >= 0):
        end = np.array(place) + ranges[i] * np.array(
            [math.cos(0.3 + ANGLES[i]), math.sin(0.3 + ANGLES[i])]
        )
        rows = things_at(scene, 38.5, 39.5, FRACTIONS[i])
        gaps = [
            distance_to_segments(end, row[None])[0]
            if len(row) == 4
            else abs(math.dist(end, row[:2]) - row[2])
            for row in rows
        ]
        assert gaps[hits[i]] < 1e-9
        assert min(gaps) > gaps[hits[i]] - 1e-9
