import contextlib
import math
import select
import socket
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError
from tests.platform.devices.inbox import Inbox

from impslam.component import build
from impslam.platform.devices.base import now
from impslam.platform.devices.rplidar import RPLidar
from impslam.platform.devices.rplidar_protocol import Nodes
from impslam.platform.devices.rplidar_scans import NodeClock, Turns, laser_scan
from impslam.platform.virtual.rplidar import A1, RPLidarEmulator
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Event, LaserScan


def stream(turns, beams=360, shift=0.0, ranges=None, first=0):
    """Return nodes of whole turns, clockwise, evenly spaced, shifted by an angle in rad."""
    number = np.arange(turns * beams)
    values = (number % beams + 1) / 100.0 if ranges is None else np.tile(ranges, turns)
    angles = (number * 2 * np.pi / beams + shift) % (2 * np.pi)
    return Nodes(first, number % beams == 0, angles, values, np.full(len(number), 15.0))


def split(nodes, cuts):
    edges = [0, *cuts, len(nodes.starts)]
    return [
        Nodes(nodes.first + a, nodes.starts[a:b], nodes.angles[a:b], nodes.ranges[a:b], None)
        for a, b in pairwise(edges)
    ]


# --------------------------------------------------------------------------- turns


def test_turns_are_split_at_their_starts(rng):
    nodes = stream(5)
    for cuts in ([], [1, 2, 3], [360], [359, 361, 1000], np.sort(rng.integers(1, 1799, 40))):
        turns = Turns()
        found = [turn for part in split(nodes, cuts) for turn in turns.add(part)]
        assert [turn.first for turn in found] == [0, 360, 720, 1080]
        for turn in found:
            assert turn.slots == 360
            np.testing.assert_array_equal(turn.numbers, np.arange(360))
            np.testing.assert_allclose(turn.ranges, np.arange(1, 361) / 100)
        assert turns.broken == 0


def test_a_turn_without_a_start_is_dropped():
    turns = Turns()
    late = split(stream(3), [100])[1]
    assert [turn.first for turn in turns.add(late)] == [360]


def test_lost_nodes_leave_their_slots_empty():
    a, _, b = split(stream(2), [100, 120])
    turns = Turns()
    (turn,) = [t for part in (a, b) for t in turns.add(part)]
    assert turn.slots == 360
    assert len(turn.ranges) == 340
    scan = laser_scan(turn, 0.0, 1e-3, (0.1, 12.0))
    np.testing.assert_array_equal(np.flatnonzero(scan.ranges == 0), np.arange(100, 120))
    np.testing.assert_allclose(scan.ranges[120:], np.arange(121, 361) / 100)


def test_a_lost_start_makes_no_turn_of_two():
    nodes = stream(4)
    starts = nodes.starts.copy()
    starts[720] = False
    turns = Turns()
    found = turns.add(Nodes(0, starts, nodes.angles, nodes.ranges, None))
    assert [turn.first for turn in found] == [0]
    assert turns.broken == 1


def test_a_false_start_makes_no_half_turn():
    nodes = stream(3)
    starts = nodes.starts.copy()
    starts[100] = True
    turns = Turns()
    found = turns.add(Nodes(0, starts, nodes.angles, nodes.ranges, None))
    assert [turn.first for turn in found] == [360]
    assert turns.broken == 2


# --------------------------------------------------------------------------- scans


def one_turn(**options):
    (turn,) = Turns().add(stream(2, **options))
    return turn


def test_an_even_turn_becomes_the_same_scan_counter_clockwise():
    scan = laser_scan(one_turn(shift=0.001), 5.0, 1e-3, (0.15, 12.0))
    assert scan.stamp == 5.0
    np.testing.assert_allclose(scan.angles, -(0.001 + np.arange(360) * 2 * np.pi / 360), atol=1e-12)
    np.testing.assert_allclose(scan.ranges, np.arange(1, 361) / 100)
    np.testing.assert_allclose(scan.time_offsets, np.arange(360) * 1e-3)
    np.testing.assert_array_equal(scan.intensities, 15.0)
    assert (scan.range_min, scan.range_max) == (0.15, 12.0)


def test_the_first_angle_may_lie_before_zero():
    scan = laser_scan(one_turn(shift=-0.03), 0.0, 1e-3, (0.15, 12.0))
    assert scan.angles[0] == pytest.approx(0.03)
    np.testing.assert_allclose(scan.ranges, np.arange(1, 361) / 100)


def test_beams_have_the_angles_of_their_targets():
    """A post on the device's right (clockwise 90 deg) is at -90 deg of the laser frame."""
    ranges = np.where(np.arange(360) == 90, 1.0, 3.0)
    scan = laser_scan(one_turn(ranges=ranges), 0.0, 1e-3, (0.15, 12.0))
    found = Lidar2D(range_max=12.0).scan(scan, np.zeros(3))
    post = found.points[np.isclose(found.ranges, 1.0)]
    np.testing.assert_allclose(post, [[0.0, -1.0]], atol=1e-9)


def test_uneven_angles_are_rounded_by_half_a_step_at_most(rng):
    nodes = stream(2)
    spoilt = (nodes.angles + rng.normal(0, math.radians(0.2), len(nodes.angles))) % (2 * np.pi)
    (turn,) = Turns().add(Nodes(0, nodes.starts, spoilt, nodes.ranges, None))
    scan = laser_scan(turn, 0.0, 1e-3, (0.15, 12.0))
    steps = np.diff(scan.angles)
    np.testing.assert_allclose(steps, steps[0])
    taken = np.flatnonzero(scan.ranges)
    origin = np.round(scan.ranges[taken] * 100).astype(int) - 1
    assert len(np.unique(origin)) == len(origin)  # none is used twice
    errors = (scan.angles[taken] + spoilt[origin] + np.pi) % (2 * np.pi) - np.pi
    assert abs(errors).max() <= 0.5 * abs(steps[0]) + 1e-9
    assert len(taken) > 340


def test_a_measurement_with_an_echo_is_preferred():
    """Of two measurements for one beam, the one with an echo is kept, even if its angle is farther off."""
    nodes = stream(2)
    angles, ranges = nodes.angles.copy(), nodes.ranges.copy()
    angles[200] = angles[201] - 0.3 * 2 * np.pi / 360
    ranges[201] = 0.0
    (turn,) = Turns().add(Nodes(0, nodes.starts, angles, ranges, None))
    scan = laser_scan(turn, 0.0, 1e-3, (0.15, 12.0))
    assert scan.ranges[201] == pytest.approx(2.01)
    assert scan.ranges[200] == 0.0


# --------------------------------------------------------------------------- clock


@pytest.mark.parametrize("rate", [1970.0, 2000.0, 4070.0])
def test_the_clock_estimates_rate_and_offset_from_late_arrivals(rate, rng):
    clock, begin = NodeClock(), 1.7e9
    arrived = begin
    for step in range(1, 1200):
        true = begin + step * 0.01
        number = math.floor((true - begin) * rate)
        delay = 0.0005 + rng.exponential(0.003) + (0.05 if rng.random() < 0.01 else 0.0)
        delay += 0.06 if 600 < step < 670 else 0.0  # a machine that is busy for a while
        arrived = max(arrived, true + delay)
        clock.observe(number, arrived)
        if step > 400:
            at_zero, period = clock.fit()
            assert at_zero + number * period == pytest.approx(true, abs=0.0025)
            assert period == pytest.approx(1 / rate, rel=5e-4)


def test_unnoticed_losses_of_bytes_are_detected():
    clock, rate = NodeClock(), 2000.0
    for step in range(1200):
        time_ = step * 0.01
        lost = 100 if time_ > 5.0 else 0  # 50 ms
        clock.observe(int(time_ * rate) - lost, time_)
        if time_ > 6.1:
            at_zero, period = clock.fit()
            assert at_zero + (time_ * rate - 100) * period == pytest.approx(time_, abs=0.002)


def test_there_is_no_fit_before_enough_arrivals():
    clock = NodeClock()
    assert clock.fit() is None
    for step in range(30):
        clock.observe(step, step * 0.01)
    assert clock.fit() is None


# --------------------------------------------------------------------------- device


class Rings:
    """Surroundings whose ranges encode the time at which each beam was fired, modulo 8 s."""

    def __init__(self, begin, beams=A1.beams):
        self.begin, self.offsets = begin, np.arange(beams) * A1.beam_time

    def ranges(self, time_):
        return 1.0 + (time_ + self.offsets) % 8.0


class Line:
    """An emulator behind TCP on loopback, in real time."""

    def __init__(self, emulator):
        self.emulator, self.begin = emulator, now()
        self.server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self.server.getsockname()[1]}"
        self.closing = threading.Event()
        self.cut = False
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self):
        self.server.settimeout(0.1)
        while not self.closing.is_set():
            with contextlib.suppress(OSError):
                link, _ = self.server.accept()
                with link:
                    self.pump(link)

    def pump(self, link):
        link.settimeout(1.0)
        while not self.closing.is_set() and not self.cut:
            if select.select([link], [], [], 0.002)[0]:
                data = link.recv(4096)
                if not data:
                    return
                self.emulator.receive(data, now() - self.begin)
            link.sendall(self.emulator.due(now() - self.begin))
        self.cut = False

    def close(self):
        self.closing.set()
        self.thread.join()
        self.server.close()


@pytest.fixture
def line():
    begun = Line(RPLidarEmulator(Rings(now())))
    yield begun
    begun.close()


def device(line, **options):
    return RPLidar(port=line.url, latency=line.emulator.latency, retry=0.05, **options)


@pytest.mark.parametrize("mode", ["express", "standard"])
def test_scans_come_with_the_right_beams_and_stamps(line, mode):
    lidar, inbox = device(line, mode=mode), Inbox()
    lidar.start(inbox)
    scans = inbox.wait(LaserScan, 12)
    lidar.stop()
    errors = []
    for reading in scans:
        scan = reading.message
        assert len(scan.ranges) == (400 if mode == "express" else 200)
        assert (scan.range_min, scan.range_max) == (0.15, 12.0)
        assert np.diff(scan.angles).max() < 0
        assert (scan.intensities is None) == (mode == "express")
        fired = scan.ranges - 1.0  # s, modulo 8
        times = scan.stamp - line.begin + scan.time_offsets
        known = scan.ranges > 0
        errors.append(np.median((times - fired + 4.0)[known] % 8.0 - 4.0))
    # Stamps are right within the minimum delay of this computer; on an idle one within 3 ms.
    assert -0.02 < np.median(errors) < 0.05
    assert np.std(errors[4:]) < 0.02
    health = lidar.health()
    assert health.counts["LaserScan"] >= 12
    assert health.counts.get("corrupt", 0) == 0
    text = inbox.of(Event)[0].message.text
    assert "A1" in text
    assert "firmware 1.29" in text
    assert line.emulator._scan is None  # it was told to stop


def test_a_reboot_and_a_cut_line_are_survived(line):
    lidar, inbox = device(line, timeout=0.5), Inbox()
    lidar.start(inbox)
    inbox.wait(LaserScan, 2)
    line.emulator.reboot(now() - line.begin)
    inbox.wait(LaserScan, len(inbox.of(LaserScan)) + 3)
    line.cut = True
    inbox.wait(LaserScan, len(inbox.of(LaserScan)) + 3)
    lidar.stop()
    errors = [r.message.text for r in inbox.of(Event) if r.message.level == "error"]
    assert len(errors) == 2
    assert "sends no measurements" in errors[0]


def test_a_lidar_with_an_error_is_reset(line, monkeypatch):
    monkeypatch.setattr("impslam.platform.devices.rplidar.BOOT_TIME", 0.1)
    line.emulator.error_code = 0x8002
    lidar, inbox = device(line), Inbox()
    lidar.start(inbox)
    inbox.wait(LaserScan, 1)
    lidar.stop()
    assert lidar.health().counts["reset"] == 1


def test_a_lasting_error_is_notified_once_with_its_code(line, monkeypatch):
    monkeypatch.setattr("impslam.platform.devices.rplidar.BOOT_TIME", 0.05)
    monkeypatch.setattr(
        RPLidarEmulator, "error_code", property(lambda _: 0x8002, lambda *_: None), raising=False
    )
    lidar, inbox = device(line), Inbox()
    lidar.start(inbox)
    (event, *_) = inbox.wait(Event, 1)
    time.sleep(0.5)
    lidar.stop()
    assert len(inbox.of(Event)) == 1
    assert "0x8002" in event.message.text


def test_silence_on_the_line_is_explained():
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        lidar, inbox = RPLidar(port=url, retry=0.05), Inbox()
        lidar.start(inbox)
        (event, *_) = inbox.wait(Event, 1)
        lidar.stop()
    assert "no RPLidar answers" in event.message.text
    assert "115200" in event.message.text


def test_it_is_registered_by_its_name():
    assert build("device", {"kind": "rplidar", "port": "/dev/imp-lidar"}).baud == 115200


def test_a_motor_duty_above_its_maximum_is_refused():
    with pytest.raises(ValidationError, match="less than or equal to 1023"):
        RPLidar(pwm=65536)
