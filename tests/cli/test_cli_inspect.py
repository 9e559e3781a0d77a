from __future__ import annotations

import json
import re
from itertools import islice

import numpy as np
import pytest
from tests.sources.logs import write_acfr_park

from impslam.cli.inspect import _range_limits
from impslam.cli.inspect_statistics import ScanGeometry
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.types import Climate, LaserScan, OdometryPose, WheelAngles

NAN = float("nan")


def test_room(imp, room) -> None:
    said = imp("inspect", room)
    assert said.code == 0
    words = " ".join(said.out.split())
    assert "/scan sensor_msgs/msg/LaserScan yes scan 100" in words
    assert "LaserScan 100 10.0 9.9 0.100 0 0" in words
    assert "beams 682" in words
    assert "field of view 239.4 deg" in words
    assert "sweep 67 ms" in words
    assert "odometry encoders, 2.1" in words
    assert "no problems found" in words


def scan(stamp: float, n: int = 21, r: float = 2.0) -> LaserScan:
    return LaserScan(stamp, np.linspace(-1, 1, n), np.full(n, r), np.zeros(n), 0.1, 9.0)


@pytest.fixture
def write(tmp_path):
    def to_log(messages):
        with McapWriter(tmp_path / "log.mcap", "imp") as writer:
            for message in messages:
                writer.write(message)
        return tmp_path / "log.mcap"

    return to_log


def test_temperature_and_humidity_are_shown(imp, write) -> None:
    air = [Climate(1.0, 21.5, 0.375), Climate(2.0, 24.25, 0.41)]
    log = write([scan(1.0), *air, WheelAngles(1.0, 0, 0)])
    words = " ".join(imp("inspect", log).out.split())
    assert "temperature 21.5 to 24.2 deg C" in words
    assert "humidity 37.5 to 41.0 %" in words
    told = json.loads(imp("inspect", log, "--json").out)["air"]
    assert told == {"temperature_celsius": [21.5, 24.25], "humidity_share": [0.375, 0.41]}
    without = write([scan(1.0), WheelAngles(1.0, 0, 0)])
    assert "deg C" not in imp("inspect", without).out


def test_clocks(imp, write) -> None:
    stamps = [10.0, 10.1, 10.1, 10.05, 10.2, 40.2]
    log = write([scan(stamp) for stamp in stamps] + [WheelAngles(10.0, 0, 0)])
    said = imp("inspect", log)
    assert "LaserScan 6 0.2 30.2 30.000 1 1" in " ".join(said.out.split())
    for problem in ("gap", "backward stamp", "repeated stamp"):
        assert f"note: 1 x {problem}: {log}" in said.out


def test_scans_of_changing_length_and_invalid_beams(imp, write) -> None:
    log = write([scan(1.0, 21), scan(2.0, 31, 0.0), scan(3.0, 31, 0.0), WheelAngles(1.0, 0, 0)])
    said = imp("inspect", log)
    assert "beams          21 to 31" in said.out
    assert "invalid beams  74.7 %" in said.out
    assert "problem: 2 x scan without valid beams" in said.out
    assert "few valid beams" not in said.out
    assert "not in the log" in said.out


def test_scans_with_few_valid_beams_are_counted_apart_from_those_without(imp, write) -> None:
    stamped = [scan(1.0), scan(2.0, r=0.0), scan(3.0, 7), scan(4.0, 8)]
    said = imp("inspect", write([*stamped, WheelAngles(1.0, 0, 0)]))
    assert "problem: 1 x scan without valid beams" in said.out
    assert "2 of 4 scans have some, but fewer than 10 valid ranges" in said.out


@pytest.mark.parametrize(
    ("angles", "degrees"),
    [
        (np.radians(np.arange(-90.0, 91.0)), "180.0"),
        (np.radians(np.arange(360.0)), "360.0"),
        (np.radians(np.linspace(0.0, 360.0, 360)), "360.0"),  # the last beam repeats the first
        (np.radians(np.arange(0.0, 359.0)), "358.0"),
        (np.zeros(1), "0.0"),
    ],
)
def test_the_field_of_view_is_the_angle_from_beam_to_beam(imp, write, angles, degrees) -> None:
    n = len(angles)
    log = write([LaserScan(1.0, angles, np.full(n, 2.0), np.zeros(n)), WheelAngles(1.0, 0, 0)])
    assert f"field of view  {degrees} deg" in imp("inspect", log).out


def test_a_log_without_odometry_has_none(imp, write) -> None:
    log = write([scan(1.0), scan(2.0)])
    said = imp("inspect", log, "-c", "default").out
    assert re.search(r"^odometry +none$", said, re.MULTILINE)
    assert "0.00 m" not in said
    wheels = write([WheelAngles(1.0, 0, 0), WheelAngles(2.0, 1, 1)])
    said = imp("inspect", wheels, "-c", "default").out
    assert "reads: nothing in this log" in said
    assert re.search(r"^odometry +none$", said, re.MULTILINE)


@pytest.mark.parametrize("scans", [[], [scan(5.0)]])
def test_odometry_without_scans_has_the_length_of_its_path(imp, write, scans) -> None:
    """Three circles of 1 m radius end where they began."""
    turns = np.linspace(0.0, 6.0 * np.pi, 301)
    poses = [np.array([np.sin(a), 1.0 - np.cos(a), a]) for a in turns]
    log = write([*scans, *(OdometryPose(0.1 * k, pose) for k, pose in enumerate(poses))])
    fit = "--set", "odometry.kind=odometry_pose"
    assert "odometry_pose, 18.85 m, 1080 deg of turns" in imp("inspect", log, *fit).out
    told = json.loads(imp("inspect", log, *fit, "--json").out)["odometry"]
    assert told["way_m"] == pytest.approx(6.0 * np.pi, rel=1e-3)
    assert told["turns_rad"] == pytest.approx(6.0 * np.pi)


def test_a_log_of_detections_needs_no_scan(imp, tmp_path) -> None:
    said = imp("inspect", write_acfr_park(tmp_path / "park"))
    words = " ".join(said.out.split())
    assert "acfr_park, preset victoria-park" in words
    assert "trees Detections yes zt 3" in words
    assert "scans none" in words
    assert "no problems found" in words
    said = imp("inspect", tmp_path / "park", "-c", "imp")
    assert "contains no LaserScan for mapping" in said.out


def test_clocks_apart(imp, write) -> None:
    log = write([scan(1.0), scan(2.0), WheelAngles(101.0, 0, 0), WheelAngles(102.0, 0, 0)])
    (fix,) = re.findall(r"--set ([^\s;]+)", imp("inspect", log).out)
    key, _, seconds = fix.partition("=")
    assert key == "sensors.lidar.latency"
    assert float(seconds) == pytest.approx(-100.0, abs=1.0)  # by the order of the log
    said = imp("inspect", log, "--set", fix)
    assert said.code == 0
    assert "clocks differ" not in said.out


def test_the_odometry_that_would_fit(imp, write) -> None:
    log = write([scan(1.0), OdometryPose(1.0, np.zeros(3)), OdometryPose(2.0, np.ones(3))])
    assert "use --set odometry.kind=odometry_pose" in imp("inspect", log).out
    said = imp("inspect", log, "--set", "odometry.kind=odometry_pose")
    assert "odometry_pose, 1.41 m, 57 deg" in said.out
    assert "no problems found" in said.out


def test_the_odometry_that_would_fit_and_what_it_needs(imp, write) -> None:
    log = write([scan(1.0), WheelAngles(1.0, 0, 0), WheelAngles(2.0, 1, 1)])
    alone = "--set", "odometry.kind=odometry_pose"
    fix = "odometry.wheel_radius=WHEEL_RADIUS --set odometry.track=TRACK"
    said = imp("inspect", log, "-c", "default", *alone).out
    assert f"use --set odometry.kind=encoders --set {fix}" in said
    values = "kind=encoders", "wheel_radius=0.1", "track=0.4"
    settings = [word for value in values for word in ("--set", f"odometry.{value}")]
    said = imp("inspect", log, "-c", "default", *settings)
    assert said.code == 0, said.err


@pytest.mark.real
def test_real_logs(imp, data_folder) -> None:
    said = imp("inspect", data_folder / "turtlebot3" / "turtlebot3.bag", "-c", "turtlebot3-waffle")
    words = " ".join(said.out.split())
    assert said.code == 0, said.err
    assert "LaserScan 457 5.0" in words
    assert "beams 360" in words
    assert "odometry encoders, 2" in words


def test_json(imp, room) -> None:
    facts = json.loads(imp("inspect", room, "--json").out)
    assert facts["preset"] == "imp"
    assert {"/scan", "/joint_states"} <= {s["name"] for s in facts["streams"] if s["used"]}
    assert facts["clocks"]["LaserScan"]["count"] == 100
    assert facts["problems"] == facts["findings"] == []


@pytest.fixture(scope="module")
def arena(tmp_path_factory):
    """The beginning of a drive through the arena."""
    log = tmp_path_factory.mktemp("arena") / "arena.mcap"
    with McapWriter(log, "imp") as writer:
        for message in islice(simulate(load_world("arena"), seed=0), 12_000):
            writer.write(message)
    return log


def test_a_sweep_in_the_wrong_order_is_named_before_a_run(imp, arena, tmp_path) -> None:
    wrong = "--set", "sensors.lidar.last_beam_first=true"
    problem = "problem: sweep reversed: the first beam of a scan was measured first: "
    for command in (("inspect",), ("run", "-o", tmp_path / "run")):
        words = " ".join(imp(*command, arena, *wrong).out.split())
        assert problem in words
        assert "--set sensors.lidar.last_beam_first=false" in words
    assert "the beams of a scan are timed wrongly, by 0.13 s from the first to the last" in words
    assert "TRACKING" not in words


def test_a_finding_and_its_setting(imp, arena, tmp_path) -> None:
    """A drive of the arena read with another robot's wheels: named by inspect and by the run itself."""
    wrong = "odometry.wheel_radius=0.11", "odometry.track=0.693"
    settings = [word for one in wrong for word in ("--set", one)]
    said = imp("inspect", arena, *settings).out
    assert "problem: wrong preset: " in said
    assert "they fit preset imp: -c imp" in said
    assert "no problems found" not in said
    run = imp("run", arena, "-o", tmp_path / "run", *settings).out
    assert "reads: preset imp; scan /scan" in run
    assert "problem: wrong preset: " in run


@pytest.mark.parametrize(
    ("limits", "shown"),
    [
        ((0.1, 9.0), "0.10 m (messages) to 9.00 m (messages)"),
        ((NAN, 9.0), "up to 9.00 m (messages)"),
        ((0.1, NAN), "from 0.10 m (messages)"),
        ((NAN, NAN), "none"),
    ],
)
def test_range_limits_that_are_not_given_are_not_named(limits, shown) -> None:
    assert _range_limits(ScanGeometry(limits=limits)) == shown
