"""`imp calibrate`: a config that loads, a picture, numbers, and one line for what cannot be done."""

import json

import pytest

from impslam.config import load
from impslam.simulation.robot import SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter

SETTINGS = ("--set", "sensors.lidar.mount=[0.1,0.03,0.1]")


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    """A log of a figure of eight in the room."""
    world, log = load_world("room"), tmp_path_factory.mktemp("eight") / "eight.mcap"
    way = ((0.9, 0.3), (1.5, 0.9), (0.9, 1.3), (0.3, 0.9), (0.9, 0.4), (0.3, -0.3), (-0.2, 0.3))
    plan = world.robot.model_copy(update={"waypoints": way, "lookahead": 0.2})
    with McapWriter(log, "imp") as writer:
        for message in simulate(world.model_copy(update={"robot": plan, "cylinders": ()})):
            writer.write(message)
    return log


def test_files(imp, eight, tmp_path):
    config, numbers = tmp_path / "calibrated.toml", tmp_path / "numbers.json"
    said = imp("calibrate", eight, *SETTINGS, "-o", config, "--json", numbers)
    assert said.code == 0
    words = " ".join(said.out.split())
    assert "parameter unit observable config found std" in words
    assert "track m yes 0.4" in words
    assert "range_scale 1 no" in words
    assert "gyro: bias" in words
    loaded = load(config)
    assert loaded.sensors["lidar"]["mount"][0] == pytest.approx(0.15, abs=0.01)
    assert config.read_text().startswith("# Calibrated from eight.mcap\n# wheel_radius: ")
    assert config.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    told = json.loads(numbers.read_text())
    assert told["config"]["sensors"]["lidar"]["mount"] == list(loaded.sensors["lidar"]["mount"])
    assert [one["name"] for one in told["parameters"]][:3] == [
        "wheel_radius",
        "right_left_ratio",
        "track",
    ]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), "no log given"),
        (("LOG", "-o", "x.txt"), "x.txt: the config is written as TOML"),
        (("LOG", "--keep", "trak"), "--keep trak: no such parameter"),
        (("LOG", "-c", "default"), "no OdometryPose to calibrate"),
    ],
)
def test_refusals(imp, eight, words, expected):
    said = imp("calibrate", *(eight if word == "LOG" else word for word in words))
    assert said.code == 2
    assert expected in said.err
    assert len(said.err.splitlines()) == 1


def drive(world, path, waypoints, seed=0):
    """Write the log of a robot with unequal wheels on its way in a world."""
    encoders = WheelEncoders.perfect(radius_sigma=0.01, track_sigma=0.02)
    world = load_world(world)
    plan = world.robot.model_copy(update={"waypoints": waypoints, "lookahead": 0.1})
    robot = SimulatedRobot(encoders=encoders, imu=None)
    with McapWriter(path, "imp") as writer:
        for message in simulate(world.model_copy(update={"robot": plan}), robot, seed):
            writer.write(message)
    return path


def test_squares(imp, tmp_path):
    """Wheels by UMBmark: as unequal as the robot's seed has them."""
    left = ((0.0, 1.0), (-1.0, 1.0), (-1.0, 0.0), (0.0, 0.0), (0.0, 0.05))
    logs = [drive("arena", tmp_path / "left.mcap", left)]
    said = imp("calibrate", *logs, "--square", "1")
    assert said.code == 2
    assert "1 squares turn left and 0 right" in said.err
