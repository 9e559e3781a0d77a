"""World files: what they hold, the truth they give, and what is said about wrong ones."""

import math

import numpy as np
import pytest

from impslam.errors import ConfigError
from impslam.simulation.drive import drive
from impslam.simulation.scene import Scene
from impslam.simulation.world import World, load_world, parse_world, shipped_worlds

MINIMAL = "[robot]\nwaypoints = [[1.0, 0.0]]\n"
WALL = '[[walls]]\nname = "a"\nstart = [0, 0]\nend = [4, 0]\n'


def test_shipped_worlds_load_with_their_names():
    assert {"arena", "corridor", "room"} <= set(shipped_worlds())
    for name in shipped_worlds():
        assert load_world(name).name == name


def test_arena_is_that_of_the_thesis():
    truth = {mark.name: mark for mark in load_world("arena").landmarks()}
    expected = {
        "wall 1": (0, -0.3048),
        "wall 2": (0.3048, 0),
        "wall 3": (0, 6.0960),
        "wall 4": (-1.6764, 0),
        "cylinder 1": (-1.2192, 1.5240),
        "cylinder 2": (-0.6096, 3.3528),
        "cylinder 3": (-1.2192, 5.1816),
    }
    assert {name: mark.kind for name, mark in truth.items()} == {
        name: name.split()[0] for name in expected
    }
    for name, position in expected.items():
        np.testing.assert_allclose(truth[name].position, position, atol=1e-12)
    assert truth["cylinder 2"].parameters["radius"] == 0.1524


def test_wall_truth_is_foot_distance_and_angle_and_its_ends_lie_on_it():
    for mark in load_world("corridor").landmarks():
        if mark.kind == "wall":
            r, alpha = mark.parameters["r"], mark.parameters["alpha"]
            normal = np.array([math.cos(alpha), math.sin(alpha)])
            np.testing.assert_allclose(mark.position, r * normal, atol=1e-12)
            assert r >= 0.0
            np.testing.assert_allclose(mark.end_points @ normal, r, atol=1e-12)


def test_wall_through_the_origin_keeps_its_normal():
    mark = parse_world(MINIMAL + WALL, "w.toml").landmarks()[0]
    assert mark.parameters["r"] == 0.0
    assert mark.parameters["alpha"] == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("[robot", "w.toml: not valid TOML"),
        ("", "w.toml: robot is missing"),
        (MINIMAL + "[[wals]]\nx = 1", "did you mean 'walls'?"),
        (MINIMAL + "[[cylinders]]\ncenter = [0, 0]\nradius = 1", "cylinders.0.centre is missing"),
        (MINIMAL + "[[cylinders]]\ncentre = [0, 0]\nradius = -1", "cylinders.0.radius = -1"),
        (MINIMAL + "[[cylinders]]\ncentre = [0, nan]\nradius = 1", "cylinders.0.centre.1 = nan"),
        (MINIMAL + "sped = 1", "did you mean 'speed'?"),
        (MINIMAL + WALL + WALL, "the name 'a' is given twice"),
        (MINIMAL + WALL.replace("4", "0"), "walls.0: start and end are the same"),
        (MINIMAL + WALL + '[[doors]]\nwall = "b"\nat = 1', "doors.0: no wall named 'b'"),
        (MINIMAL + WALL + '[[doors]]\nwall = "a"\nat = 3.5', "doors.0: extends beyond"),
        (MINIMAL + WALL + 2 * '[[doors]]\nwall = "a"\nat = 1\n', "doors.1: overlaps"),
        (MINIMAL + WALL + '[[doors]]\nwall = "a"\nat = 1\nopen = [[5, 3]]', "doors.0.open"),
        (MINIMAL + "[[people]]\nwaypoints = [[1, 1], [1, 1]]", "people.0: point 0"),
        (MINIMAL.replace("1.0", "0.0"), "robot: point 0"),
        (MINIMAL + "limit = 0.0", "robot.limit = 0.0"),
    ],
)
def test_wrong_worlds_are_one_line_that_names_file_and_key(text, part):
    with pytest.raises(ConfigError) as error:
        parse_world(text, "w.toml")
    message = str(error.value)
    assert part in message
    assert message.startswith("w.toml: ")
    assert "\n" not in message
    assert len(message) < 200


def test_unknown_world_and_unreadable_file(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'arena'"):
        load_world("arenna")
    binary = tmp_path / "x.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read as text"):
        load_world(binary)
    with pytest.raises(ConfigError, match="no such world or file"):
        load_world(tmp_path)


def test_world_file_by_path(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(MINIMAL + WALL, "utf-8")
    assert load_world(path).name == "mine"
    assert load_world(str(path)).walls[0].length == 4.0


DOOR = """
[[doors]]
wall = "a"
at = 1.0
width = 1.0
recess = 0.1
open = [[10.0, 20.0]]
swing_time = 2.0
"""


def leaf(time: float) -> np.ndarray:
    return Scene(parse_world(MINIMAL + WALL + DOOR, "w.toml")).leaves(time)[0]


def test_door_cuts_the_wall_and_stands_back_behind_its_jambs():
    scene = Scene(parse_world(MINIMAL + WALL + DOOR, "w.toml"))
    expected = [[0, 0, 1, 0], [1, 0, 1, -0.1], [2, 0, 2, -0.1], [2, 0, 4, 0]]
    assert sorted(scene.segments.round(12).tolist()) == sorted(expected)
    np.testing.assert_allclose(leaf(9.0), [1, -0.1, 2, -0.1], atol=1e-12)


@pytest.mark.parametrize(
    ("time", "angle"),
    [(10.0, 0.0), (11.0, 45.0), (12.0, 90.0), (20.0, 90.0), (21.0, 45.0), (22.0, 0.0)],
)
def test_door_swings_by_its_schedule(time, angle):
    x0, y0, x1, y1 = leaf(time)
    assert math.degrees(math.atan2(y0 - y1, x1 - x0)) == pytest.approx(angle, abs=1e-9)
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(1.0)


def test_room_behind_a_door_has_five_walls():
    text = MINIMAL + WALL + DOOR
    bare = Scene(parse_world(text, "w.toml")).segments
    room = Scene(parse_world(text + "room = [3.0, 2.0]", "w.toml")).segments
    assert len(room) == len(bare) + 5
    assert room[:, 1].min() == pytest.approx(-2.1)


PERSON = """
[[people]]
waypoints = [[0.0, 2.0], [10.0, 2.0]]
start = 5.0
speed = 1.0
"""


def legs(time: float, extra: str = "") -> np.ndarray:
    return Scene(parse_world(MINIMAL + PERSON + extra, "w.toml")).legs(time)


def test_a_person_stands_still_before_and_after_the_walk():
    np.testing.assert_allclose(legs(0.0)[:, :2], [[0, 2.1], [0, 1.9]], atol=1e-12)
    np.testing.assert_allclose(legs(5.0), legs(0.0), atol=1e-12)
    np.testing.assert_allclose(legs(9.0)[:, 0].mean(), 4.0, atol=1e-12)
    np.testing.assert_allclose(legs(15.0)[:, :2], [[10, 2.1], [10, 1.9]], atol=1e-12)
    np.testing.assert_allclose(legs(99.0), legs(15.0), atol=1e-12)


def test_gait_moves_each_foot_forward_only_and_lets_it_rest():
    times = np.linspace(7.0, 13.0, 6001)
    feet = np.array([legs(time)[:, 0] for time in times])
    speeds = np.diff(feet, axis=0) / np.diff(times)[:, None]
    assert speeds.min() > -1e-3
    assert speeds.min() < 0.01
    assert speeds.max() == pytest.approx(2.0, abs=0.01)
    np.testing.assert_allclose(feet.mean(axis=1), times - 5.0, atol=1e-9)


def test_person_who_returns_is_back_after_two_laps():
    extra = "returns = true"
    np.testing.assert_allclose(legs(20.0, extra)[:, 0].mean(), 5.0, atol=1e-9)
    np.testing.assert_allclose(legs(25.0, extra)[:, 0].mean(), 0.0, atol=1e-9)
    np.testing.assert_allclose(legs(30.0, extra)[:, 0].mean(), 5.0, atol=1e-9)


@pytest.mark.parametrize("name", shipped_worlds())
def test_robot_never_touches_anything_in_shipped_worlds(name):
    world: World = load_world(name)
    scene, way = Scene(world), drive(world.robot)
    gaps = [
        scene.clearance(pose[:2], float(time))
        for pose, time in zip(way.poses[::10], way.times[::10], strict=True)
    ]
    # 5 cm beside the outline: the arena's start is 0.3048 m from two walls.
    assert min(gaps) > world.robot.radius + 0.05


def test_corridor_is_what_the_uncontrolled_environment_needs():
    world = load_world("corridor")
    assert max(wall.length for wall in world.walls) >= 45.0
    assert len(world.people) >= 4
    assert {bool(door.open) for door in world.doors} == {True, False}
    assert all(0.05 <= door.recess <= 0.10 for door in world.doors)
