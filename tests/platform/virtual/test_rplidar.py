import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.platform.devices.rplidar_parser import Parser
from impslam.platform.devices.rplidar_protocol import (
    Answer,
    Command,
    Condition,
    Info,
    Nodes,
    request,
)
from impslam.platform.virtual.rplidar import A1, BANNER, RPLidarEmulator

N = A1.beams


class Ramp:
    """Ranges that encode the beam, and the turn in centimetres."""

    def __init__(self):
        self.requested_times = []

    def ranges(self, time):
        self.requested_times.append(time)
        return np.where(np.arange(N) % 7 == 3, 0.0, 1.0 + np.arange(N) / 100.0)


def emulator(**options):
    return RPLidarEmulator(Ramp(), **options)


def ask(lidar, command, payload=b"", time=0.0):
    lidar.receive(request(command, payload), time)
    return Parser().feed(lidar.due(time))


def test_it_answers_info_and_health():
    lidar = emulator(model=0x31)
    (info,) = ask(lidar, Command.INFO)
    assert Info.parse(info.data).model == 0x31
    (health,) = ask(lidar, Command.HEALTH)
    assert Condition.parse(health.data) == Condition(0, 0)
    lidar.error_code = 0x8002
    (health,) = ask(lidar, Command.HEALTH)
    assert Condition.parse(health.data) == Condition(2, 0x8002)
    assert ask(lidar, Command.SCAN) == []  # it does not scan with an error
    lidar.receive(request(Command.RESET), 0.0)
    assert lidar.due(0.0) == BANNER
    assert lidar.error_code == 0


@pytest.mark.parametrize(
    ("command", "each", "at_once"),
    [(Command.SCAN, 2, 1), (Command.EXPRESS, 1, 32)],
)
def test_its_measurements_are_parsed_exactly(command, each, at_once):
    lidar, parser = emulator(), Parser()
    lidar.receive(request(command, bytes(5) if command == Command.EXPRESS else b""), 0.3)
    parts = []
    for tick in range(300, 1900):
        parts += [p for p in parser.feed(lidar.due(tick / 1000)) if isinstance(p, Nodes)]
    ranges = np.concatenate([p.ranges for p in parts])
    angles = np.concatenate([p.angles for p in parts])
    starts = np.concatenate([p.starts for p in parts])
    # 1.6 s, minus the latency of a turn and incomplete data.
    expected = (1.6 - lidar.latency) * N * A1.rate / each
    assert expected - 3 * at_once - 6 <= len(ranges) <= expected
    beams = np.arange(len(ranges)) * each % N
    truth = np.where(beams % 7 == 3, 0.0, 1.0 + beams / 100.0)
    np.testing.assert_allclose(ranges, truth, atol=1e-9)
    turned = np.degrees(angles) - beams * 360 / N
    assert abs((turned + 180) % 360 - 180).max() < 1 / 64
    assert abs(np.flatnonzero(starts) * each % N).max() <= 1
    assert not parser.counts


def test_each_turn_is_computed_once_and_after_its_end():
    lidar = emulator()
    surroundings = lidar._surroundings
    lidar.receive(request(Command.SCAN), 1.0)
    for tick in range(1000, 2000):
        before = len(surroundings.requested_times)
        lidar.due(tick / 1000)
        assert all(tick / 1000 >= time + 0.1 for time in surroundings.requested_times[before:])
    np.testing.assert_allclose(surroundings.requested_times, 1.0 + np.arange(9) / 10)


def test_stop_and_the_motor_end_a_scan():
    lidar = emulator(model=0x28)
    lidar.receive(request(Command.PWM, bytes(2)), 0.0)
    assert ask(lidar, Command.SCAN) == []  # the motor is off
    lidar.receive(request(Command.PWM, (660).to_bytes(2, "little")), 0.0)
    lidar.receive(request(Command.SCAN), 0.0)
    assert len(lidar.due(1.0)) > 5000
    lidar.receive(request(Command.STOP), 1.0)
    assert lidar.due(2.0) == b""


def test_a_reboot_ends_the_scan():
    lidar = emulator()
    lidar.receive(request(Command.SCAN), 0.0)
    lidar.due(0.5)
    lidar.reboot(0.5)
    assert lidar.due(0.6) == BANNER
    assert lidar.due(2.0) == b""


def test_a_request_with_a_wrong_checksum_is_ignored():
    lidar = emulator()
    broken = bytearray(request(Command.EXPRESS, bytes(5)))
    broken[-1] ^= 1
    lidar.receive(bytes(broken), 0.0)
    assert lidar.due(1.0) == b""


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=40),
            st.sampled_from([request(c) for c in Command if c < 0x80]),
            st.sampled_from([request(Command.EXPRESS, bytes(5)), request(Command.PWM, b"\0\0")]),
        ),
        max_size=10,
    )
)
def test_it_handles_any_bytes(pieces):
    lidar = emulator()
    for k, piece in enumerate(pieces):
        lidar.receive(piece, k * 0.05)
        lidar.due(k * 0.05 + 0.01)
    lidar.receive(bytes(300), 1.0)  # ends an incomplete request
    lidar.receive(request(Command.STOP), 1.0)
    lidar.due(1.0)  # a scan that the rest may have begun
    lidar.receive(request(Command.INFO), 1.0)
    answers = [p for p in Parser().feed(lidar.due(1.0)) if isinstance(p, Answer)]
    assert answers
