from __future__ import annotations

import csv
import math

import numpy as np

from impslam.columns import messages
from impslam.simulation.world import load_world
from impslam.sources.rosbag import RosBag
from impslam.types import Imu, LaserScan, TruePose

BESIDE = (".mcap", ".truth.tum", ".landmarks.csv")


def test_same_seed_same_bytes(imp, room, tmp_path) -> None:
    for name, seed in (("again", 0), ("other", 1)):
        assert imp("simulate", "room", "-o", tmp_path / f"{name}.mcap", "--seed", seed).code == 0
    for ending in BESIDE:
        assert (tmp_path / f"again{ending}").read_bytes() == (
            room.with_name(f"room{ending}").read_bytes()
        )
    assert (tmp_path / "other.mcap").read_bytes() != room.read_bytes()


def test_truth_has_a_pose_for_every_scan(room) -> None:
    with RosBag(path=room) as source:
        read = list(messages(source.batches()))
    stamps = [m.stamp for m in read if isinstance(m, LaserScan)]
    poses = {m.stamp: m.pose for m in read if isinstance(m, TruePose)}
    rows = np.loadtxt(room.with_name("room.truth.tum"))
    np.testing.assert_allclose(rows[:, 0], stamps, rtol=0.0, atol=1e-9)
    true = np.array([poses[stamp] for stamp in stamps])
    np.testing.assert_allclose(rows[:, 1:3], true[:, :2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(rows[:, [3, 4, 5]], 0.0)
    yaw = 2.0 * np.arctan2(rows[:, 6], rows[:, 7])
    np.testing.assert_allclose(yaw, true[:, 2], rtol=0.0, atol=1e-9)


def test_true_landmarks(room) -> None:
    with room.with_name("room.landmarks.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    world = load_world("room")
    assert set(rows) == {part.name for part in (*world.walls, *world.cylinders)}
    assert float(rows["near"]["x"]), float(rows["near"]["radius"]) == (0.5, 0.1)
    east = rows["east"]
    assert east["kind"] == "wall"
    assert float(east["r"]) == 2.4
    assert math.isclose(float(east["alpha"]), 0.0)
    assert [float(east[k]) for k in ("x1", "y1", "x2", "y2")] == [2.4, -0.8, 2.4, 1.8]
    assert east["radius"] == ""


def test_a_custom_world(imp, tmp_path) -> None:
    world = tmp_path / "own.toml"
    world.write_text("[robot]\nwaypoints = [[0.5, 0.0]]\n[[walls]]\nstart=[-1,-1]\nend=[2,-1]\n")
    said = imp("simulate", world, "-o", tmp_path / "deep" / "log.mcap")
    assert said.code == 0, said.err
    assert "'own'" in said.out


def test_the_robot_can_be_changed(imp, tmp_path) -> None:
    robot, log = tmp_path / "robot.toml", tmp_path / "log.mcap"
    robot.write_text('imu = "none"\n[lidar]\nbeams = 100\n')
    result = imp(
        "simulate", "room", "-o", log, "--robot", robot, "--set", "lidar.rate=5"
    )  # fmt: skip
    assert result.code == 0
    with RosBag(path=log) as source:
        read = list(messages(source.batches()))
    scans = [m for m in read if isinstance(m, LaserScan)]
    assert {len(m.ranges) for m in scans} == {100}
    assert math.isclose(float(np.median(np.diff([m.stamp for m in scans]))), 0.2)
    assert not any(isinstance(m, Imu) for m in read)


def test_errors_in_the_robot_are_one_line(imp, tmp_path) -> None:
    log = tmp_path / "log.mcap"
    robot = tmp_path / "robot.toml"
    robot.write_text("[lidar]\nbeam = 100\n")
    for options, told in (
        (["--set", "lidar.rat=5"], "lidar.rat is not a parameter; did you mean 'rate'?"),
        (["--set", "lidar.rate=-5"], "lidar.rate = -5"),
        (
            ["--set", "lidar.rate=40"],
            "a sweep of 682 beams takes 0.0665 s, longer than the 0.025 s",
        ),
        (
            ["--set", "lidar.beams=1440"],
            "a sweep of 1440 beams takes 0.141 s, longer than the 0.1 s",
        ),
        (["--set", "lidar.angle_step=0"], "682 beams with an angle_step of 0 rad cover 0 rad"),
        (["--set", "lidar.angle_step=0.0175"], "cover 11.9 rad; they must cover more than 0"),
        (["--set", "lidar"], "expected key=value"),
        (["--set", "imu=off"], "imu = 'off': must be none or a table of parameters"),
        (["--robot", robot], "robot.toml: lidar.beam is not a parameter"),
        (["--robot", tmp_path / "absent.toml"], "no such file"),
    ):
        result = imp("simulate", "room", "-o", log, *options)
        assert result.code == 2
        assert told in result.err
        assert not log.exists()


def test_the_log_is_an_mcap_file(imp, tmp_path) -> None:
    said = imp("simulate", "room", "-o", tmp_path / "log.bag")
    assert (said.code, list(tmp_path.iterdir())) == (2, [])
    assert "log.bag: the file name must end in .mcap" in said.err
