"""A robot with a lidar ahead and one turned round behind, from its log to the map."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest

import impslam
from impslam.cli import main
from impslam.columns import batches
from impslam.config import load
from impslam.errors import ConfigError
from impslam.observers.health import HealthMonitor
from impslam.run import Run
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.types import Event, LaserScan, TruePose

FRONT, REAR = (0.15, 0.0, 0.0), (-0.2, 0.05, math.pi)
NARROW = {"beams": 256, "angle_min": -math.pi / 4, "angle_step": math.pi / 512, "beam_time": 0.0}
"""A quarter of a turn: neither sees what the other sees."""
CONFIG = """
base = "imp"
[sensors.lidar]
kind = "none"
[sensors.front]
kind = "lidar2d"
stream = "{front}"
mount = [0.15, 0.0, 0.0]
range_min = 0.02
range_max = 5.6
extractors.walls.kind = "split_merge"
extractors.cylinders.kind = "circle"
[sensors.rear]
kind = "lidar2d"
stream = "{rear}"
mount = [-0.2, 0.05, 3.141592653589793]
range_min = 0.02
range_max = 5.6
extractors.walls.kind = "split_merge"
extractors.cylinders.kind = "circle"
"""


def drive(mount):
    """Return what a robot without noise records in the room by a lidar on this mount."""
    lidar = Lidar.perfect(mount=mount, **NARROW)
    robot = SimulatedRobot(encoders=WheelEncoders.perfect(), lidar=lidar, imu=None)
    return list(simulate(load_world("room"), robot))


@pytest.fixture(scope="module")
def rows():
    """All messages of one drive, with what comes after the topic of each."""
    rear = [(m, "/rear") for m in drive(REAR) if isinstance(m, LaserScan)]
    front = [(m, "/front" if isinstance(m, LaserScan) else "") for m in drive(FRONT)]
    return sorted(front + rear, key=lambda row: row[0].stamp)


@pytest.fixture(scope="module")
def log(rows, tmp_path_factory):
    path = tmp_path_factory.mktemp("two") / "two.mcap"
    with McapWriter(path) as writer:
        for message, below in rows:
            writer.write(message, below=below)
        writer.write(Event(message.stamp, "info", "lidar", "stopped"))
    return path


def config(tmp_path, front="/scan/front", rear="/scan/rear"):
    path = tmp_path / "two.toml"
    path.write_text(CONFIG.format(front=front, rear=rear))
    return path


def test_both_lidars_make_one_map(rows, log, tmp_path):
    known = impslam.run(log, config(tmp_path))
    truth = {m.stamp: m.pose for m, _ in rows if isinstance(m, TruePose)}
    scans = [m.stamp for m, _ in rows if isinstance(m, LaserScan)]
    assert len(known.path()) == len(scans)
    stamps = np.array(sorted(truth))
    for t, x, y, _ in known.path():
        nearest = stamps[np.argmin(np.abs(stamps - t))]
        assert math.dist((x, y), truth[nearest][:2]) < 2e-4
    feet = np.array([mark.position for mark in known.landmarks if mark.kind == "wall"])
    assert len(feet) == 4
    for foot in [(0, -0.8), (2.4, 0), (0, 1.8), (-0.6, 0)]:
        assert np.abs(feet - foot).max(axis=1).min() < 2e-4
    (post,) = [mark.position for mark in known.landmarks if mark.kind == "cylinder"]
    np.testing.assert_allclose(post, [1.9, -0.2], atol=2e-4)  # the other one is out of sight


def test_each_lidar_has_keyframes(log, tmp_path):
    known = impslam.run(log, config(tmp_path))
    origins = known.keyframes.origins
    for mount in (FRONT, REAR):
        assert (np.abs(origins - mount[:2]).max(axis=1) < 1e-9).sum() > 0.3 * len(origins)


def test_lidars_taken_for_each_other_make_another_map(log, tmp_path):
    """What the test of the map rests on."""
    known = impslam.run(log, config(tmp_path, front="/scan/rear", rear="/scan/front"))
    feet = np.array([mark.position for mark in known.landmarks if mark.kind == "wall"])
    assert np.abs(feet - [2.4, 0.0]).max(axis=1).min() > 0.1


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (
            {"rear": "/scan/raer"},
            "sensors.rear.stream = '/scan/raer': no such stream in the log; "
            "did you mean '/scan/rear'?",
        ),
        ({"front": "front"}, "sensors.front.stream = 'front': no such stream"),
        (
            {"rear": "/joint_states"},
            "sensors.rear.stream = '/joint_states': it contains WheelAngles",
        ),
        ({"rear": "/rosout"}, "sensors.rear.stream = '/rosout': it contains no LaserScan; name"),
        ({"rear": "/scan/front"}, "sensors.rear.stream = NAME"),
        ({"front": "", "rear": ""}, "sensors.rear.stream = NAME"),
    ],
)
def test_a_wrong_stream_is_told_by_its_key(log, tmp_path, names, said, capsys):
    path = config(tmp_path, **names)
    with pytest.raises(ConfigError) as error:
        impslam.run(log, path)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert main(["run", str(log), "-c", str(path), "-o", str(tmp_path / "run"), "--quiet"]) == 2
    said_by_imp = capsys.readouterr().err
    assert said in said_by_imp
    assert said_by_imp.count("\n") == 1
    assert main(["inspect", str(log), "-c", str(path), "--quiet"]) in {0, 2}
    assert "wanted" not in capsys.readouterr().err


def test_inspect_says_what_is_not_read(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["inspect", str(log), "--quiet"]) == 0
    alone = capsys.readouterr().out
    assert "not read: scan is /scan/front" in alone
    assert main(["inspect", str(log), "-c", str(config(tmp_path)), "--quiet"]) == 0
    assert "not read" not in capsys.readouterr().out


def cut(scan, beams):
    """Return a scan with its first beams only."""
    few = {name: getattr(scan, name)[:beams] for name in ("angles", "ranges", "time_offsets")}
    return replace(scan, intensities=None, **few)


@pytest.mark.parametrize("late", ["front", "rear"])
def test_a_lidar_may_be_late(rows, tmp_path, late):
    """Its scans come after those that the other one measured three times later."""
    latency = 0.27
    shifted = [
        (replace(m, stamp=m.stamp + latency) if below == f"/{late}" else m, below)
        for m, below in rows
    ]
    with McapWriter(tmp_path / "log.mcap") as writer:
        for message, below in sorted(shifted, key=lambda row: row[0].stamp):
            writer.write(message, below=below)
    right, wrong = (
        impslam.run(
            tmp_path / "log.mcap", config(tmp_path), [f"sensors.{late}.latency={seconds}"]
        ).path()
        for seconds in (latency, 0.0)
    )
    truth = {m.stamp: m.pose for m, _ in rows if isinstance(m, TruePose)}
    assert len(right) == sum(isinstance(m, LaserScan) for m, _ in rows)
    assert worst(right, truth) < 1e-3
    assert worst(wrong, truth) > 0.02


def worst(path, truth):
    """Return the largest distance in m from true poses by stamp, as long as there are any."""
    stamps = np.array(sorted(truth))
    path = path[path[:, 0] <= stamps[-1]]
    nearest = stamps[np.abs(path[:, :1] - stamps).argmin(axis=1)]
    return max(math.dist(row[1:3], truth[t][:2]) for row, t in zip(path, nearest, strict=True))


WIDE = {"beams": 541, "angle_min": -2.36, "angle_step": 4.72 / 540, "beam_time": 0.0, "rate": 20.0}


def at_rest(name, mount, offset):
    """Yield rows of 3 s at rest, with noise with which scans at rest are matched."""
    world, lidar = load_world("office"), Lidar(mount=mount, sigma=0.02, range_max=20.0, **WIDE)
    world = world.model_copy(update={"robot": world.robot.model_copy(update={"rest": 3.0})})
    robot = SimulatedRobot(lidar=lidar, encoders=WheelEncoders.perfect(), imu=None)
    for m in itertools.takewhile(lambda m: m.stamp < 1003.0, simulate(world, robot)):
        if isinstance(m, LaserScan):
            yield name, replace(m, stamp=m.stamp + offset)
        elif not offset:
            yield type(m).__name__, m


def test_a_robot_at_rest_is_not_pushed_if_a_mount_is_off_by_1_cm(tmp_path):
    """The scans of the two lidars fit poses that are as far apart, in turn."""
    off = REAR[0] + 0.01, REAR[1], REAR[2]
    rows = [*at_rest("front", FRONT, 0.0), *at_rest("rear", off, 0.01)]
    monitor, matched = HealthMonitor(), ["tracker.kind=scan_to_map", "estimator.kind=graph"]
    run = Run(load(config(tmp_path, "front", "rear"), matched), [monitor])
    for batch in batches(sorted(rows, key=lambda row: row[1].stamp)):
        run.feed(batch)
    run.flush()
    assert run.scans > 100
    assert monitor.health.counts()["TRACKING"] == run.scans


def test_inspect_tells_the_lidars_apart(rows, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    rear = [cut(message, 8) for message, below in rows if below == "/rear"][:33]
    front = [(message, below) for message, below in rows if below != "/rear"]
    scans = sum(isinstance(message, LaserScan) for message, _ in front)
    with McapWriter(tmp_path / "log.mcap") as writer:
        for message, below in [*front, *((scan, "/rear") for scan in rear)]:
            writer.write(message, below=below)
    words = ["inspect", str(tmp_path / "log.mcap"), "-c", str(config(tmp_path)), "--quiet"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"LaserScan /scan/front {scans} 10.0" in said
    assert "LaserScan /scan/rear 33 10.0" in said
    assert "front: beams 256" in said
    assert "rear: beams 8 " in said
    assert "33 of 33 scans have some, but fewer than 10 valid ranges" in said
    assert "sensors.rear.range_min" in said
    assert "sensors.front.range_min" not in said
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["lidars"]
    assert {name: lidar["beams"] for name, lidar in told.items()} == {"front": [256], "rear": [8]}
