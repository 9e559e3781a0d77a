"""The whole virtual IMP, with devices that only record calls."""

import time

import numpy as np
import pytest

from impslam.errors import ConfigError
from impslam.platform.devices.port import open_port, read_some, write_all
from impslam.platform.virtual.control import answer
from impslam.platform.virtual.faults import (
    Delay,
    LineNoise,
    Malfunction,
    Reboot,
    Stall,
    Unplug,
    parse_fault,
)
from impslam.platform.virtual.imp import SLICE, VirtualImp
from impslam.platform.virtual.pty_line import PtyLine
from impslam.platform.virtual.tcp_line import TcpLine
from impslam.platform.virtual.urg import UrgEmulator
from impslam.simulation.body import Body
from impslam.simulation.body_lidar import LidarSweeps
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import World

pytest.importorskip("serial")

EMPTY = World.model_validate({"robot": {"start": (0, 0, 0), "waypoints": [(1, 0)]}})


class Ticker:
    """Sends a byte every 10 ms; drives at the speed in cm/s of the last received byte."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.sent_times: list[tuple[float, float]] = []
        self.calls: list[float] = []
        self.reboots: list[float] = []

    def receive(self, data: bytes, time: float) -> None:
        self.body.drive(data[-1] / 100, data[-1] / 100)

    def due(self, time: float) -> bytes:
        self.calls.append(time)
        out = bytearray()
        while 0.01 * len(self.sent_times) <= time + 1e-9:
            self.sent_times.append((time, self.body.time))
            out.append(len(self.sent_times) % 256)
        return bytes(out)

    def reboot(self, time: float) -> None:
        self.reboots.append(time)


class Camera:
    """Records its calls."""

    def __init__(self) -> None:
        self.done: list[object] = []

    def serve(self) -> str:
        return "http://127.0.0.1:1/stream"

    def unplug(self, seconds: float) -> None:
        self.done.append(("unplug", seconds))

    def freeze(self, seconds: float) -> None:
        self.done.append(("freeze", seconds))

    def close(self) -> None:
        self.done.append("close")


@pytest.fixture
def imp(tmp_path):
    body = Body(EMPTY, SimulatedRobot.perfect())
    emulators = {"autopilot": Ticker(body), "lidar": Ticker(body)}
    made = VirtualImp(
        body, emulators, {"autopilot": PtyLine(tmp_path / "autopilot"), "lidar": TcpLine()}
    )
    yield made
    made.close()


def ticker(imp: VirtualImp, name: str = "autopilot") -> Ticker:
    return imp._emulators[name]


def step(imp: VirtualImp, begin: float, end: float) -> None:
    for time_ in np.arange(round(1000 * begin) + 1, round(1000 * end) + 1) / 1000:
        imp.step(float(time_))


def hear(port, number: int) -> bytes:
    """Read some bytes, with delays of the kernel."""
    data, end = b"", time.monotonic() + 5.0
    while len(data) < number and time.monotonic() < end:
        data += read_some(port, 0.01)
    assert len(data) == number
    return data


def test_ports_are_told_by_device(imp, tmp_path):
    imp.add_camera(Camera())
    ports = imp.ports()
    assert ports["autopilot"] == str(tmp_path / "autopilot")
    assert ports["lidar"].startswith("socket://127.0.0.1:")
    assert ports["camera"] == "http://127.0.0.1:1/stream"


def test_devices_are_heard_and_obeyed(imp):
    with open_port(imp.ports()["autopilot"], 115200) as port:
        step(imp, 0.0, 0.02)
        assert hear(port, 2) == bytes([2, 3])  # the first was sent before a host was connected
        write_all(port, bytes([30]))
        time.sleep(0.05)
        step(imp, 0.02, 1.0)
    np.testing.assert_allclose(imp.truth()["twist"], [0.3, 0.0], atol=1e-3)


def test_a_late_machine_catches_up_in_slices(imp):
    imp.step(0.001)
    imp.step(0.2)
    calls = np.array(ticker(imp).calls)
    assert np.diff(calls).max() <= SLICE + 1e-9
    moments = np.array(ticker(imp).sent_times)
    # What is due at 10, 20, ... ms is read off the body as it was then, not as it is at the end.
    np.testing.assert_allclose(moments[:, 1], 0.01 * np.arange(len(moments)), atol=SLICE)
    assert len(moments) == 21


def test_a_stall_ends(imp):
    imp.body.drive(0.3, 0.3)
    step(imp, 0.0, 1.0)
    imp.fault(Stall(side="left", seconds=1.0))
    step(imp, 1.0, 1.99)
    truth = imp.truth()
    assert truth["stalled"] == ["left"]
    np.testing.assert_allclose(truth["motors"], [0.0, 0.3], atol=1e-3)
    np.testing.assert_allclose(truth["commanded"], [0.3, 0.3])
    step(imp, 1.99, 3.0)
    assert imp.truth()["stalled"] == []
    np.testing.assert_allclose(imp.truth()["motors"], [0.3, 0.3], atol=1e-3)


def test_both_sides_can_stall(imp):
    imp.body.drive(0.3, 0.3)
    imp.fault(Stall(side="both", seconds=1.0))
    step(imp, 0.0, 0.5)
    np.testing.assert_array_equal(imp.truth()["pose"], 0.0)


def test_a_robot_is_carried_to_a_place_or_its_start(imp):
    imp.fault(parse_fault({"fault": "carry", "place": [0.5, 0.25]}))
    np.testing.assert_array_equal(imp.truth()["pose"], [0.5, 0.25, 0.0])
    imp.fault(parse_fault({"fault": "carry"}))
    np.testing.assert_array_equal(imp.truth()["pose"], 0.0)


def test_faults_reach_the_line_or_the_device_that_they_are_for(imp):
    imp.add_camera(camera := Camera())
    with open_port(imp.ports()["autopilot"], 115200) as port:
        step(imp, 0.0, 0.1)
        hear(port, 10)
        imp.fault(Delay(device="autopilot", seconds=0.1))
        step(imp, 0.1, 0.19)
        assert read_some(port, 0.01) == b""
        imp.fault(LineNoise(device="autopilot", rate=1.0, seconds=0.1, kind="drop"))
        step(imp, 0.19, 0.28)
        hear(port, 9)
    counts = imp.status()["lines"]["autopilot"]
    assert counts["drop"] == 9
    imp.fault(Reboot(device="lidar"))
    assert ticker(imp, "lidar").reboots == [0.28]
    assert ticker(imp).reboots == []
    imp.fault(Unplug(device="lidar", seconds=0.1))
    step(imp, 0.28, 0.36)
    assert imp.status()["lines"]["lidar"]["unplugged"] == 8
    imp.fault(Unplug(device="camera", seconds=2))
    imp.fault(Delay(device="camera", seconds=1))
    assert camera.done == [("unplug", 2.0), ("freeze", 1.0)]
    imp.close()
    assert camera.done[-1] == "close"


def test_only_a_lidar_that_tells_statuses_has_malfunctions(imp):
    with pytest.raises(ConfigError, match="only a URG"):
        imp.fault(Malfunction())
    imp._emulators["lidar"] = urg = UrgEmulator(LidarSweeps(imp.body))
    urg.receive(b"BM\n", 0.0)
    assert urg.laser
    imp.fault(Malfunction(status=60))
    urg.receive(b"BM\n", 0.1)
    assert urg.due(0.2).endswith(b"BM\n01Q\n\n")  # refused, the laser does not work


@pytest.mark.parametrize("device", ["camera", "lidar"])
def test_a_fault_of_what_is_not_there_is_refused(tmp_path, device):
    body = Body(EMPTY)
    line = PtyLine(tmp_path / "autopilot")
    imp = VirtualImp(body, {"autopilot": Ticker(body)}, {"autopilot": line})
    with pytest.raises(ConfigError, match=f"no {device}"):
        imp.fault(parse_fault({"fault": "unplug", "device": device, "seconds": 1}))
    imp.close()


def test_in_real_time_it_keeps_time_and_tells_when_commands_take_effect(imp):
    sent: list[float] = []
    with open_port(imp.ports()["autopilot"], 115200) as port:

        def serve() -> None:
            # From within the loop, so that a loaded machine does not come between the two times.
            if imp.body.time > 0.05 * (len(sent) + 1) and len(sent) < 5:
                sent.append(time.monotonic())
                write_all(port, bytes([10 + len(sent)]))

        begin = time.monotonic()
        imp.run(lambda: imp.body.time > 0.4 and len(imp.truth()["commands"]) == 5, serve)
    truth = imp.truth()
    assert truth["time"] == pytest.approx(time.monotonic() - begin, abs=0.2)
    assert truth["monotonic"] == pytest.approx(time.monotonic(), abs=0.2)
    assert [entry[1] for entry in truth["commands"]] == [0.11, 0.12, 0.13, 0.14, 0.15]
    latencies = np.array([entry[0] for entry in truth["commands"]]) - sent
    assert (latencies > 0).all()
    assert np.median(latencies) < 0.05
    late = imp.truth(since=truth["commands"][2][0])["commands"]
    assert [entry[1] for entry in late] == [0.14, 0.15]
    status = imp.status()
    assert status["passes"] > 10
    assert 0.0 <= status["lateness"]["p50"] <= status["lateness"]["p99"]
    assert status["lateness"]["p99"] <= status["lateness"]["max"]


def test_a_pass_that_comes_late_is_counted(imp, caplog):
    naps = iter([0.05])
    for _ in range(99):
        imp._lateness.add(0.03)  # a single one is not logged: computers are busy at times
    begin = time.monotonic()
    imp.run(lambda: time.monotonic() - begin > 0.1, lambda: time.sleep(next(naps, 0.0)))
    assert imp.status()["late"] >= 100
    assert imp.status()["lateness"]["max"] > 0.04
    assert "late 100 times by now" in caplog.text
    assert imp.body.time == pytest.approx(time.monotonic() - begin, abs=0.2)


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("{", "not JSON"),
        ("[1]", "a JSON object"),
        ('{"ask": "port"}', "did you mean 'ports'"),
        ('{"ask": "truth", "since": "x"}', "since"),
        ('{"fault": "fire"}', "fault"),
        ('{"fault": "unplug", "device": "camera", "seconds": 1}', "no camera"),
    ],
)
def test_what_cannot_be_done_is_answered_in_one_line(imp, line, error):
    reply = answer(imp, line)
    assert "\n" not in reply
    assert reply.startswith('{"error": ')
    assert error in reply


def test_what_can_be_asked_is_answered(imp):
    assert '"lidar": "socket://' in answer(imp, '{"ask": "ports"}')
    assert '"pose": [0.0, 0.0, 0.0]' in answer(imp, '{"ask": "truth"}')
    assert '"late": 0' in answer(imp, '{"ask": "status"}')
    assert answer(imp, '{"fault": "stall", "side": "left", "seconds": 1}') == "{}"
    assert imp.truth()["stalled"] == ["left"]
