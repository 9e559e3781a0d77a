"""`imp calibrate`: a config that loads, a picture, numbers, and one line for what cannot be done."""

import json
import math
import re

import pytest

from impslam.config import load
from impslam.geometry.se2 import between
from impslam.simulation.robot import SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.types import LaserScan, TruePose

SETTINGS = ("--set", "sensors.lidar.mount=[0.1,0.03,0.1]")


def figure_of_eight():
    """Return the messages of a drive in the room."""
    world = load_world("room")
    way = ((0.9, 0.3), (1.5, 0.9), (0.9, 1.3), (0.3, 0.9), (0.9, 0.4), (0.3, -0.3), (-0.2, 0.3))
    plan = world.robot.model_copy(update={"waypoints": way, "lookahead": 0.2})
    return simulate(world.model_copy(update={"robot": plan, "cylinders": ()}))


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    """A log of a figure of eight."""
    log = tmp_path_factory.mktemp("eight") / "eight.mcap"
    with McapWriter(log, "imp") as writer:
        for message in figure_of_eight():
            writer.write(message)
    return log


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A CSV log of the same drive; its speeds are 10 % too small, its poses stand still."""
    log = tmp_path_factory.mktemp("table") / "table.csv"
    last, lines = None, []
    for message in figure_of_eight():
        if isinstance(message, TruePose):
            if last is not None:
                speed, _, rate = between(last.pose, message.pose) / (message.stamp - last.stamp)
                lines.append([last.stamp, 0.9 * speed, rate, 0.0, 0.0, 0.0, *BEAMS * [""]])
            last = message
        elif isinstance(message, LaserScan):
            kept = message.ranges[:: len(message.ranges) // BEAMS][:BEAMS].tolist()
            lines.append([message.stamp, *5 * [""], *kept])
            angles = message.angles[:: len(message.ranges) // BEAMS].tolist()
    head = ",".join(
        ["t,speed,turn_rate,a,b,c", *(f"{math.degrees(a):.6f}" for a in angles[:BEAMS])]
    )
    log.write_text("\n".join([head, *(",".join(map(str, line)) for line in lines)]) + "\n")
    return log


BEAMS = 170


def test_files(imp, eight, tmp_path):
    config, numbers = tmp_path / "calibrated.toml", tmp_path / "numbers.json"
    (tmp_path / "mine.toml").write_text('base = "imp"\n')
    mine = ("-c", tmp_path / "mine.toml")
    said = imp("calibrate", eight, *SETTINGS, *mine, "-o", config, "--json", numbers)
    assert said.code == 0
    assert 'base = "mine.toml"' in config.read_text("utf-8"), "both can be copied to the robot"
    words = " ".join(said.out.split())
    assert "parameter unit observable config found std" in words
    assert "track m yes 0.4" in words
    assert "range_scale 1 no" in words
    assert "gyro: bias" in words
    loaded = load(config)
    assert loaded.sensors["lidar"]["mount"][0] == pytest.approx(0.15, abs=0.01)
    comments = config.read_text("utf-8").splitlines()
    assert comments[0] == "# Calibrated from eight.mcap"
    assert re.fullmatch(r"# wheel_radius: ± [\d.e-]+ m", comments[1])
    assert re.fullmatch(r"# right_left_ratio: ± [\d.e-]+", comments[2]), "a ratio has no unit"
    assert config.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    told = json.loads(numbers.read_text())
    assert told["config"]["sensors"]["lidar"]["mount"] == list(loaded.sensors["lidar"]["mount"])
    assert [one["name"] for one in told["parameters"]][:3] == [
        "wheel_radius",
        "right_left_ratio",
        "track",
    ]


def test_odometry_that_the_log_has_chosen(imp, table, tmp_path):
    """The written config names it, although that of the preset is another one."""
    config = tmp_path / "calibrated.toml"
    said = imp("calibrate", table, *SETTINGS, "-o", config)
    assert said.code == 0
    assert "robot's lengths: --keep speed_scale" in " ".join(said.out.split())
    odometry = load(config).odometry
    assert odometry["kind"] == "velocity"
    assert odometry["speed_scale"] == pytest.approx(1.0 / 0.9, abs=0.02)


def test_odometry_that_stands_still(imp, table):
    still = ("--columns", "x=a,y=b,theta=c", "-c", "default")
    said = imp("calibrate", table, *still)
    assert said.code == 2
    assert "its odometry stands still" in said.err


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


def drive(world, path, waypoints, seed=0, start=(0.0, 0.0, 0.5 * math.pi)):
    """Write the log of a robot with unequal wheels on its way in a world."""
    encoders = WheelEncoders.perfect(radius_sigma=0.01, track_sigma=0.02)
    world = load_world(world)
    changes = {"start": start, "waypoints": waypoints, "lookahead": 0.1}
    plan = world.robot.model_copy(update=changes)
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
    right = ((-1.0, 1.0), (0.0, 1.0), (0.0, 0.0), (-1.0, 0.0), (-1.0, 0.05))
    logs.append(drive("arena", tmp_path / "right.mcap", right, start=(-1.0, 0.0, 0.5 * math.pi)))
    files = ["-o", tmp_path / "squares.toml", "--json", tmp_path / "squares.json"]
    said = imp("calibrate", *logs, "--square", "1", *files)
    assert said.code == 0, said.err
    wheels = load(tmp_path / "squares.toml").odometry
    assert wheels["right_left_ratio"] == pytest.approx(0.983, abs=0.003)
    assert wheels["track"] == pytest.approx(0.412, abs=0.004)
    found = json.loads((tmp_path / "squares.json").read_text())
    assert [one["is_left"] for one in found["squares"]] == [True, False]
    assert found["umbmark"]["error"] == pytest.approx(0.23, abs=0.03)
    assert found["config"]["odometry"]["track"] == wheels["track"]
    said = imp("calibrate", *logs, "--square", "1", "--keep", "track")
    assert "--keep cannot be combined with --square" in said.err
