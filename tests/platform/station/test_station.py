"""The station as a whole, with failing parts."""

import logging
import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from tests.platform.station.test_mapper import drain
from tests.recorded import perfect
from tests.rings import GRAPH, ring
from tests.waiting import wait_until

import impslam
from impslam.errors import ImpError
from impslam.map import Map
from impslam.platform.devices.base import Device, Reading, now
from impslam.platform.station.recorder import RecordingError
from impslam.platform.station.station import Station
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Climate, LaserScan, TruePose

NO_DISK = 10**18  # bytes that no disk has free


class Silent(Device):
    """Never opens."""

    name = "silent"

    def _serve(self) -> None:
        self._stopping.wait()


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "logs"


def station(folder, devices=(), floor=0):
    return Station(dict(devices), "imp", folder, (0.5, 1.0), floor)


def test_a_full_disk_is_notified_and_the_robot_keeps_running(folder):
    robot = station(folder, floor=NO_DISK)
    robot.begin(record=True, map_=False)
    status = robot.health().recording
    assert not status.active
    assert "is free on the disk" in status.error
    assert robot.events[-1].level == "error"
    robot.stop()


def test_begin_starts_recording(folder):
    robot = station(folder)
    robot.begin(record=True, map_=False)
    assert robot.health().recording.active
    robot.stop()
    assert [log.cut for log in robot.store.logs()] == [False]


def test_a_part_that_fails_to_stop_does_not_block_the_others(folder, monkeypatch):
    robot = station(folder, {"lidar": Silent()})
    robot.recorder.start()

    def fail():
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(robot.drive_control, "stop", fail)
    with pytest.raises(ZeroDivisionError):
        robot.stop()
    assert not robot.health().recording.active


def test_a_folder_that_cannot_be_created_is_notified_in_one_line(folder):
    folder.write_text("a file")
    robot = station(folder)
    with pytest.raises(RecordingError, match="cannot be written"):
        robot.recorder.start()
    with pytest.raises(ImpError, match="maps: cannot be written"):
        robot.save_map()
    assert robot.store.logs() == []


def test_readings_of_many_threads_leave_the_events_bounded_and_readable(folder):
    robot = station(folder)
    ended = threading.Event()

    def notify():
        while not ended.is_set():
            robot._notify("info", "news")
            robot.receive(Reading(Climate(now(), 20.0, 0.5), now(), "toy"))

    threads = [threading.Thread(target=notify) for _ in range(4)]
    for thread in threads:
        thread.start()
    for _ in range(2000):
        assert len(list(robot.events)) <= 210  # 200, and what is just being added
    ended.set()
    for thread in threads:
        thread.join(5.0)
    assert len(robot.events) == 200


@pytest.fixture
def corridors(folder, monkeypatch):
    """A station that has mapped a ring of corridors, and the messages of a later drive."""
    robot = station(folder)
    monkeypatch.setattr(robot.mapper, "_config", GRAPH)
    monkeypatch.setattr(robot.mapper, "_prepare", lambda config: None)
    messages = [m for m in ring() if not isinstance(m, TruePose)]
    robot.start_mapping()
    send(robot, messages)
    robot.save_map()
    yield robot, [replace(m, stamp=m.stamp + 5000.0) for m in messages]
    robot.stop()


TWO_LIDARS = """
base = "imp"
sensors.lidar.kind = "none"
[sensors.front]
kind = "lidar2d"
stream = "/scan/front"
mount = [0.15, 0.0, 0.0]
[sensors.rear]
kind = "lidar2d"
stream = "/scan/rear"
mount = [-0.2, 0.05, 3.141592653589793]
"""


def sent_by_two_lidars(robot, devices):
    """Let lidars of these names send the scans of a drive, and return the live map."""
    robot.mapper._prepare = lambda config: None
    robot.start_mapping()
    wait_until(lambda: robot.mapper.status().state == "running")
    mounts = ((0.15, 0.0, 0.0), (-0.2, 0.05, math.pi))
    drives = [
        simulate(
            load_world("room"),
            SimulatedRobot(
                encoders=WheelEncoders.perfect(), lidar=Lidar.perfect(mount=mount), imu=None
            ),
        )
        for mount in mounts
    ]
    first, second = ([m for m in drive if not isinstance(m, TruePose)][:600] for drive in drives)
    readings = [
        *((m, devices[0] if isinstance(m, LaserScan) else "autopilot") for m in first),
        *((m, devices[1]) for m in second if isinstance(m, LaserScan)),
    ]
    for message, device in sorted(readings, key=lambda reading: reading[0].stamp):
        robot.receive(Reading(message, message.stamp, device))
        wait_until(lambda: robot.mapper.status().waiting == 0)
    drain(robot.mapper)
    return sum(isinstance(m, LaserScan) for m, _ in readings)


def test_the_map_of_two_lidars_is_that_of_the_recording(folder, tmp_path):
    path = tmp_path / "two.toml"
    path.write_text(TWO_LIDARS)
    robot = Station({}, str(path), folder, (0.5, 1.0), 0)
    log = robot.recorder.start()
    scans = sent_by_two_lidars(robot, ("front", "rear"))
    status = robot.mapper.status()
    assert (status.detail, status.dropped_scans) == ("", 0)
    assert not math.isnan(status.latency)
    robot.stop()
    (saved,) = folder.glob("maps/*/map.imp")
    live, recorded = Map.load(saved).path(), impslam.run(log).path()
    assert scans - 3 <= len(live) <= len(recorded) <= scans  # the last ones wait for odometry
    np.testing.assert_allclose(live, recorded[: len(live)], atol=1e-4)
    assert len(Map.load(saved).keyframes) > 0


@pytest.mark.parametrize(
    ("devices", "said"),
    [
        (("left", "right"), "nothing in the config reads the stream '/scan'; there is "),
        (("front", "raer"), "nothing in the config reads the stream '/scan'; there is "),
    ],
)
def test_a_lidar_that_the_config_does_not_read_is_reported(folder, tmp_path, devices, said, caplog):
    path = tmp_path / "two.toml"
    path.write_text(TWO_LIDARS)
    robot = Station({}, str(path), folder, (0.5, 1.0), 0)
    with caplog.at_level(logging.WARNING, "impslam"):
        sent_by_two_lidars(robot, devices)
    assert robot.mapper.status().detail.startswith(said)
    assert caplog.text.count(said) == 1
    robot.stop()


def send(robot, messages):
    while robot.mapper.status().state == "compiling":
        time.sleep(0.01)
    for message in messages:
        while robot.mapper.status().waiting > 1:
            time.sleep(0.001)
        robot.mapper.put(message)
    drain(robot.mapper)


def test_a_robot_is_localised_in_a_frozen_map(corridors):
    robot, messages = corridors
    name = robot.keeper.name
    before = (robot.maps.path(name) / "map.imp").read_bytes()
    robot.continue_map(name, frozen=True)
    send(robot, messages[:100])
    status = robot.mapper.status()
    assert (status.name, status.frozen, status.placed) == (name, True, False)
    assert robot.view.snapshot().grid is not None
    assert len(robot.view.snapshot().path) == 0
    robot.hint(0.0, 0.0)  # restarted near that position
    send(robot, messages)
    assert robot.mapper.status().placed
    with pytest.raises(ImpError, match="already located"):
        robot.hint(0.0, 0.0)
    x, y, _ = robot.view.snapshot().pose
    assert math.hypot(x - 9.0, y) < 0.3
    with pytest.raises(ImpError, match="frozen map"):
        robot.save_map()
    robot.keeper.stop()
    assert [one.name for one in robot.maps.maps()] == [name]
    assert (robot.maps.path(name) / "map.imp").read_bytes() == before


def test_a_continued_map_is_saved_as_a_new_one(corridors):
    robot, messages = corridors
    name = robot.keeper.name
    robot.continue_map(name)
    send(robot, messages)
    assert robot.mapper.status().placed
    robot.keeper.stop()
    grown, first = robot.maps.maps()
    assert (first.name, grown.name) == (name, robot.keeper.name)
    assert grown.scans == 2 * first.scans
    known = Map.load(robot.maps.path(grown.name) / "map.imp")
    assert known.keyframes.placed.all()
    robot.maps.delete(name)


def test_an_ended_map_can_be_continued_or_deleted(corridors):
    robot, messages = corridors
    name = robot.keeper.name
    with pytest.raises(ImpError, match="in progress"):
        robot.maps.delete(name)
    robot.end_mapping()
    scans = robot.mapper.status().steps
    assert [(one.name, one.scans, one.mapping) for one in robot.maps.maps()] == [
        (name, scans, False)
    ]
    wait_until(lambda: robot.view.snapshot().finished)
    shown = robot.view.snapshot()
    assert (shown.state, shown.why) == ("LOST", "mapping has ended; the robot is not tracked")
    assert len(shown.path) > 0
    robot.continue_map(name)
    send(robot, messages[:100])
    assert not robot.view.snapshot().finished
    robot.end_mapping()
    robot.maps.delete(name)


def test_a_map_that_cannot_be_read_keeps_the_present_one(folder):
    robot = station(folder)
    (folder / "maps" / "broken").mkdir(parents=True)
    (folder / "maps" / "broken" / "map.imp").write_text("no map")
    for name in ("broken", "nothing"):
        with pytest.raises(ImpError, match=name):
            robot.continue_map(name)
    assert robot.mapper.status().state == "off"


def test_the_true_pose_of_a_simulated_robot_is_shown_beside_the_estimate(folder, monkeypatch):
    robot = station(folder)
    monkeypatch.setattr(robot.mapper, "_prepare", lambda config: None)
    robot.start_mapping()
    while robot.mapper.status().state == "compiling":
        time.sleep(0.01)
    for message in perfect(load_world("room")):
        robot.receive(Reading(message, now(), "simulator"))
        while robot.mapper.status().waiting > 1:
            time.sleep(0.001)
    drain(robot.mapper)
    shown = robot.view.snapshot()
    assert np.linalg.norm(shown.pose[:2]) > 0.5
    assert shown.truth is not None
    np.testing.assert_allclose(shown.truth, shown.pose, atol=0.02)
    robot.stop()
