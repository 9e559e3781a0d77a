"""The virtual IMP in its own process: start, requests, faults, and end."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from impslam.component import build
from impslam.errors import ConfigError, ImpError
from impslam.platform.devices.base import Reading
from impslam.platform.virtual.assembly import Setup
from impslam.platform.virtual.process import VirtualRobot, _to_json
from impslam.simulation.lidar import laser_poses
from impslam.simulation.raycast import trace
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene
from impslam.simulation.world import World, load_world, shipped_worlds
from impslam.types import Event, Imu, LaserScan, WheelAngles

pytest.importorskip("serial")
pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals and signals"),
]


@pytest.fixture(scope="module")
def robot():
    with VirtualRobot("room", seed=4) as running:
        yield running


@pytest.fixture(scope="module")
def devices(robot):
    """The host's drivers and their readings."""
    readings: list[Reading] = []
    made = {
        name: build("device", {"label": name, **table}, name)
        for name, table in robot.devices().items()
        if name != "camera"
    }
    for device in made.values():
        device.start(readings.append)
    yield made, readings
    for device in made.values():
        device.stop()


def until(condition, seconds: float = 20.0) -> float:
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() < begin + seconds, "has not happened"
        time.sleep(0.005)
    return time.monotonic() - begin


def alive(pid: int) -> bool:
    with contextlib.suppress(OSError):
        os.kill(pid, 0)
        # One that has ended stays as a zombie until its parent, here process 1, asks for it.
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text("ascii")
    return False


def count(readings, kind) -> int:
    return sum(isinstance(reading.message, kind) for reading in readings)


# ---------------------------------------------------------------------------------- asking


def test_it_reports_its_ports_and_devices(robot):
    assert set(robot.ports) == {"autopilot", "lidar", "camera"}
    assert Path(robot.ports["autopilot"]).is_char_device()
    tables = robot.devices()
    assert tables["lidar"] == {"kind": "urg", "port": robot.ports["lidar"]}
    assert tables["autopilot"] == {"kind": "autopilot", "port": robot.ports["autopilot"]}
    assert tables["camera"] == {"kind": "camera", "source": robot.ports["camera"]}


def test_truth_is_stamped_by_the_shared_clock(robot):
    before = time.monotonic()
    first = robot.truth()
    np.testing.assert_allclose(first["pose"], load_world("room").robot.start)
    # The body is at its last step: a loaded computer may be late by some.
    assert before - 0.5 < first["monotonic"] < time.monotonic()
    time.sleep(0.05)
    second = robot.truth()
    assert second["monotonic"] - first["monotonic"] == pytest.approx(
        second["time"] - first["time"], abs=1e-6
    )
    assert second["time"] > first["time"]


def test_invalid_requests_are_one_line_errors(robot):
    with pytest.raises(ImpError, match="no_such"):
        robot.fault("no_such")
    with pytest.raises(ImpError, match="seconds"):
        robot.fault("unplug", device="lidar", seconds=-1)
    assert robot.truth()["time"] > 0


def test_requests_from_many_threads_are_answered(robot):
    answers: list[float] = []

    def ask() -> None:
        answers.extend(robot.truth()["time"] for _ in range(20))

    threads = [threading.Thread(target=ask) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 100


def test_a_late_answer_is_not_taken_for_the_next(robot):
    os.kill(robot.pid, signal.SIGSTOP)
    with pytest.raises(ImpError, match="does not answer within"):
        robot._request({"ask": "ports"}, timeout=0.01)
    os.kill(robot.pid, signal.SIGCONT)
    assert "pose" in robot.truth()


# ---------------------------------------------------------------------------------- with drivers


def test_the_drivers_receive_its_messages(devices):
    made, readings = devices
    until(lambda: min(count(readings, kind) for kind in (WheelAngles, Imu, LaserScan)) > 10)
    assert {name: device.health().state for name, device in made.items()} == {
        "autopilot": "ok",
        "lidar": "ok",
    }
    assert len(last_scan(readings).ranges) == 682


def assert_shows_the_room(truth, scan: LaserScan) -> None:
    """Compare with a ray along each beam from the robot's position."""
    scene = Scene(load_world("room"))
    lasers = laser_poses(np.tile(truth["pose"], (len(scan.angles), 1)), Lidar().mount)
    nothing = np.empty((2, 0, 4)), np.empty((2, 0, 3))
    standing, at_once = (scene.segments, scene.circles), np.zeros(len(scan.angles))
    expected, *_ = trace(lasers, scan.angles, at_once, standing, nothing, 5.6)
    errors = np.abs(scan.ranges - expected)
    assert np.median(errors) < 0.01
    # Without beams at edges, which read in between, and without those without an echo.
    assert np.mean(errors < 0.03) > 0.9


def last_scan(readings) -> LaserScan:
    return next(r.message for r in readings[::-1] if isinstance(r.message, LaserScan))


def test_scans_show_the_world_as_it_is(robot, devices):
    readings = devices[1]
    until(lambda: count(readings, LaserScan) > 5)
    assert_shows_the_room(robot.truth(), last_scan(readings))


def test_scans_of_the_rplidar_show_the_world_as_it_is():
    readings: list[Reading] = []
    with VirtualRobot("room", camera=False, lidar="rplidar", lidar_line="pty") as robot:
        device = build("device", robot.devices()["lidar"], "lidar")
        device.start(readings.append)
        until(lambda: count(readings, LaserScan) > 5)
        assert_shows_the_room(robot.truth(), last_scan(readings))
        device.stop()


def test_commands_move_the_wheels_soon_and_stop_without_them(robot, devices):
    autopilot = devices[0]["autopilot"]
    until(lambda: autopilot.health().state == "ok")
    latencies = []
    for k in range(30):
        sent = time.monotonic()
        autopilot.drive(0.0, 0.1 + 0.01 * (k % 2))
        until(lambda sent=sent: robot.truth(since=sent)["commands"])
        latencies.append(robot.truth(since=sent)["commands"][0][0] - sent)
    assert min(latencies) > 0
    assert np.median(latencies) < 0.05
    # No more commands: the micro-controller's timeout of 0.5 s.
    assert until(lambda: robot.truth()["commanded"] == [0.0, 0.0]) < 3.0
    until(lambda: abs(robot.truth()["twist"][1]) < 1e-3)
    assert abs(robot.truth()["pose"][2] - load_world("room").robot.start[2]) > 1e-3


def test_an_unplugged_lidar_is_lost_and_found(robot, devices):
    made, readings = devices
    lidar = made["lidar"]
    until(lambda: lidar.health().state == "ok")
    robot.fault("unplug", device="lidar", seconds=0.5)
    until(lambda: lidar.health().state == "lost")
    number = count(readings, LaserScan)
    until(lambda: lidar.health().state == "ok" and count(readings, LaserScan) > number)
    assert any(isinstance(r.message, Event) and r.message.level == "error" for r in readings)


def test_noise_is_counted_on_both_sides_and_ends(robot, devices):
    autopilot = devices[0]["autopilot"]
    until(lambda: autopilot.health().state == "ok")
    robot.fault("noise", device="autopilot", rate=0.02, seconds=0.5, kind="flip")
    time.sleep(0.7)
    until(lambda: autopilot.health().state == "ok")
    spoilt = robot.status()["lines"]["autopilot"]["flip"]
    counts = autopilot.health().counts
    assert spoilt > 0
    assert sum(number for what, number in counts.items() if "corrupt" in what) > 0
    time.sleep(0.2)
    assert robot.status()["lines"]["autopilot"]["flip"] == spoilt


def test_a_lidar_malfunction_is_recovered(robot, devices):
    made, readings = devices
    until(lambda: made["lidar"].health().state == "ok")
    robot.fault("malfunction", status=60)
    time.sleep(0.3)
    number = count(readings, LaserScan)
    until(lambda: count(readings, LaserScan) > number + 3)


def test_a_stall_is_reported(robot):
    robot.fault("stall", side="right", seconds=0.2)
    assert robot.truth()["stalled"] == ["right"]
    until(lambda: robot.truth()["stalled"] == [])


# ---------------------------------------------------------------------------------- life and death


def test_nothing_is_left_after_its_end():
    robot = VirtualRobot("room", camera=False)
    assert robot.pid == 0
    robot.start()
    pid, ports = robot.pid, robot.ports
    assert set(ports) == {"autopilot", "lidar"}
    folder = Path(ports["autopilot"]).parent
    robot.close()
    robot.close()
    assert not alive(pid)
    assert not folder.exists()
    address = ports["lidar"].removeprefix("socket://").split(":")
    with pytest.raises(OSError, match="refused"):
        socket.create_connection((address[0], int(address[1])), 1.0).close()
    with pytest.raises(ImpError, match="not running"):
        robot.truth()


def test_it_can_be_started_again(tmp_path):
    robot = VirtualRobot("room", camera=False, lidar="rplidar", lidar_line="pty")
    for _ in range(2):
        with robot:
            assert Path(robot.ports["lidar"]).is_char_device()
            assert robot.devices()["lidar"]["kind"] == "rplidar"


def test_it_ends_with_its_parent_process():
    """Even if the parent is killed, or another process has inherited the pipe."""
    program = (
        "import os, sys, time\n"
        "from impslam.platform.virtual.process import VirtualRobot\n"
        "robot = VirtualRobot('room', camera=False)\n"
        "robot.start()\n"
        "if os.fork() == 0:\n"
        "    time.sleep(60)\n"
        "print(robot.pid, robot.ports['autopilot'], os.getpgid(0), flush=True)\n"
        "time.sleep(60)\n"
    )
    starter = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    with starter.stdout:
        pid, path, group = starter.stdout.readline().split()
    try:
        assert alive(int(pid))
        starter.kill()
        starter.wait()
        until(lambda: not alive(int(pid)))
        assert not Path(path).parent.exists()
    finally:
        os.killpg(int(group), signal.SIGKILL)


def test_its_death_is_an_error():
    with VirtualRobot("room", camera=False) as robot:
        os.kill(robot.pid, signal.SIGINT)  # it ignores Ctrl-C
        assert robot.truth()["time"] > 0
        assert robot.failure == ""
        os.kill(robot.pid, signal.SIGKILL)
        for _ in range(2):
            with pytest.raises(ImpError, match="has ended"):
                robot.truth()
        until(lambda: "has ended" in robot.failure)


def test_it_ends_cleanly_when_asked_to():
    with VirtualRobot("room", camera=False) as robot:
        os.kill(robot.pid, signal.SIGTERM)
        until(lambda: not Path(robot.ports["autopilot"]).is_symlink())
        assert robot._process.wait(5.0) == 0


def test_a_world_that_cannot_be_used_is_refused():
    with pytest.raises(ConfigError, match="no such world"):
        VirtualRobot("rom")
    tiny = World.model_validate(
        {"robot": {"start": (0, 0, 0), "waypoints": [(1, 0)], "radius": 1e-3}}
    )
    robot = VirtualRobot(tiny)
    with pytest.raises(ImpError, match=r"robot\.radius"):
        robot.start()
    assert robot.pid == 0


@pytest.mark.parametrize("name", shipped_worlds())
def test_every_shipped_world_reaches_the_process_as_it_is(name, tmp_path):
    setup = Setup(world=load_world(name), folder=tmp_path)
    assert Setup.model_validate_json(_to_json(setup)) == setup
