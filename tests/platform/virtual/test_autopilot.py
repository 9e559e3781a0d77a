"""The emulated firmware follows the protocol: sensors, commands, stops, timeouts, reboots."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.platform.devices.autopilot_messages import (
    COMMANDS,
    FROM_AUTOPILOT,
    Ack,
    DriveCommand,
    Flag,
    FrameType,
    Hello,
    Reset,
    Result,
    Sensors,
    SetTime,
)
from impslam.platform.devices.framing import Decoder, Encoder
from impslam.platform.virtual.autopilot import AutopilotEmulator

STEP = 2 * math.pi / 4096
PARSE = {FrameType.HELLO: Hello.parse, FrameType.SENSORS: Sensors.parse, FrameType.ACK: Ack.parse}


class Vehicle:
    def __init__(self):
        self.commands, self.angles = [], (0.0, 0.0)

    def drive(self, left, right):
        self.commands.append((left, right))

    def wheel_angles(self):
        return self.angles

    def inertial(self):
        return np.array([0.1, -0.2, 20.0]), np.array([1.0, 2.0, 9.8])

    def heading(self):
        return math.pi / 2


class Host:
    """The host's end of the emulator."""

    def __init__(self, **settings):
        self.vehicle = Vehicle()
        self.emulator = AutopilotEmulator(self.vehicle, **{"drift": 0.0, "seed": 1, **settings})
        self.encoder, self.time, self.got = Encoder(200), 0.0, []
        self.counts = {}
        self.decoder = Decoder(FROM_AUTOPILOT, self._count)

    def _count(self, what, n):
        self.counts[what] = self.counts.get(what, 0) + n

    def pass_on(self, seconds, step=1e-3):
        for _ in range(round(seconds / step)):
            self.time += step
            for frame in self.decoder.feed(self.emulator.due(self.time)):
                self.got.append(PARSE[frame.type](frame.payload))

    def send(self, kind, payload=b""):
        sequence, wire = self.encoder.encode(kind, payload)
        self.emulator.receive(wire, self.time)
        self.pass_on(0.001)
        return sequence, self.of(Ack)[-1] if self.of(Ack) else None

    def of(self, kind):
        return [message for message in self.got if isinstance(message, kind)]


@pytest.fixture
def host():
    host = Host()
    host.pass_on(0.1)
    return host


def test_it_sends_hello_first_and_then_a_hundred_readings_a_second():
    host = Host()
    host.pass_on(3.05)
    assert isinstance(host.got[0], Hello)
    assert (host.got[0].boots, host.got[0].reset) == (1, Reset.POWER)
    assert len(host.of(Hello)) == 3
    assert len(host.of(Sensors)) == pytest.approx(300, abs=1)
    clocks = np.array([message.clock for message in host.of(Sensors)])
    np.testing.assert_allclose(np.diff(clocks), 10_000, atol=1001)
    assert host.counts == {"frames": len(host.got)}


def test_its_clock_drifts():
    host = Host(drift=100e-6)
    host.pass_on(20.0)
    assert host.of(Sensors)[-1].clock == pytest.approx(20e6 * (1 + 100e-6), abs=10_500)
    assert host.of(Sensors)[-1].clock % 10_000 == pytest.approx(2000, abs=50)


def test_inertial_readings_are_scaled_and_clipped_to_16_bits(host):
    hello, sensors = host.of(Hello)[0], host.of(Sensors)[0]
    assert sensors.gyro[:2] == (round(0.1 / hello.gyro), round(-0.2 / hello.gyro))
    assert sensors.gyro[2] == 32_767  # 20 rad/s are beyond 500 deg/s
    np.testing.assert_allclose(
        np.array(sensors.accelerometer) * hello.accelerometer, [1.0, 2.0, 9.8], atol=1e-3
    )
    fields = np.mean([m.magnetometer for m in host.of(Sensors)], axis=0) * hello.magnetometer
    np.testing.assert_allclose(fields, [0.0, -20e-6, -45e-6], atol=1e-6)


def test_a_late_call_sends_one_reading_and_skips_missed_ones(host):
    before = len(host.of(Sensors))
    host.pass_on(0.2, step=0.05)
    assert len(host.of(Sensors)) - before == 4
    host.pass_on(0.1)
    assert len(host.of(Sensors)) - before == pytest.approx(14, abs=1)


# ------------------------------------------------------------------------ commands


def test_commands_are_executed_and_answered(host):
    sequence, ack = host.send(FrameType.DRIVE, DriveCommand(300, -200).pack())
    assert host.vehicle.commands[-1] == (0.3, -0.2)
    assert ack == Ack(FrameType.DRIVE, Result.DONE, sequence, ack.clock)
    host.pass_on(0.02)
    sensors = host.of(Sensors)[-1]
    assert (sensors.applied, sensors.applied_clock) == (sequence, ack.clock)
    assert sensors.flags == Flag(0)


def test_it_stops_half_a_second_after_the_last_command(host):
    assert host.of(Sensors)[-1].flags == Flag.DEAD_MAN
    host.send(FrameType.DRIVE, DriveCommand(300, 300).pack())
    host.pass_on(0.498)
    assert host.vehicle.commands[-1] == (0.3, 0.3)
    host.pass_on(0.003)
    assert host.vehicle.commands[-1] == (0.0, 0.0)
    host.pass_on(0.01)
    assert host.of(Sensors)[-1].flags == Flag.DEAD_MAN


def test_a_stop_lasts_until_the_release_and_then_it_is_stationary(host):
    host.send(FrameType.DRIVE, DriveCommand(300, 300).pack())
    assert host.send(FrameType.STOP)[1].result is Result.DONE
    assert host.vehicle.commands[-1] == (0.0, 0.0)
    assert host.send(FrameType.DRIVE, DriveCommand(300, 300).pack())[1].result is Result.STOPPED
    assert host.vehicle.commands[-1] == (0.0, 0.0)
    host.pass_on(1.0)
    assert host.of(Sensors)[-1].flags == Flag.STOPPED
    host.send(FrameType.RELEASE)
    host.pass_on(0.02)
    assert host.of(Sensors)[-1].flags == Flag.DEAD_MAN
    assert host.vehicle.commands[-1] == (0.0, 0.0)
    host.send(FrameType.DRIVE, DriveCommand(100, 100).pack())
    assert host.vehicle.commands[-1] == (0.1, 0.1)


def test_a_release_without_a_stop_changes_nothing(host):
    host.send(FrameType.DRIVE, DriveCommand(300, 300).pack())
    host.send(FrameType.RELEASE)
    host.pass_on(0.02)
    assert host.of(Sensors)[-1].flags == Flag(0)


def test_malformed_commands_are_refused_and_do_nothing(host):
    before = list(host.vehicle.commands)
    for kind, payload in (
        (FrameType.DRIVE, b""),
        (FrameType.DRIVE, DriveCommand(30_000, 0).pack()),
        (FrameType.RELEASE, b"x"),
        (FrameType.SET_TIME, b"\0" * 7),
    ):
        assert host.send(kind, payload)[1].result is Result.MALFORMED
    assert host.vehicle.commands == before


def test_a_stop_with_a_payload_stops_too(host):
    host.send(FrameType.DRIVE, DriveCommand(300, 300).pack())
    assert host.send(FrameType.STOP, b"x")[1].result is Result.MALFORMED
    assert host.vehicle.commands[-1] == (0.0, 0.0)


def test_a_repeated_or_late_command_is_not_executed_again(host):
    _, drive = host.encoder.encode(FrameType.DRIVE, DriveCommand(300, 300).pack())
    _, stand = host.encoder.encode(FrameType.DRIVE, DriveCommand(0, 0).pack())
    commands = len(host.vehicle.commands)
    for wire in (drive, stand, stand, drive):
        host.emulator.receive(wire, host.time)
    assert host.vehicle.commands[commands:] == [(0.3, 0.3), (0.0, 0.0)]
    assert host.emulator.counts == {"frames": 2, "repeated": 1, "late": 1}


def test_its_time_is_set_and_reported_by_hello(host):
    hellos = len(host.of(Hello))
    host.send(FrameType.SET_TIME, SetTime(1_700_000_000_000_000).pack())
    assert len(host.of(Hello)) == hellos + 1
    hello = host.of(Hello)[-1]
    assert hello.clock + hello.host_offset == pytest.approx(1_700_000_000_000_000, abs=1500)


@settings(max_examples=50)
@given(st.lists(st.one_of(st.binary(max_size=80), st.sampled_from(sorted(COMMANDS))), max_size=30))
def test_any_bytes_leave_it_running_and_never_move_it(chunks):
    host = Host()
    host.pass_on(0.06)
    for chunk in chunks:
        data = chunk if isinstance(chunk, bytes) else host.encoder.encode(chunk, b"?" * 5)[1]
        host.emulator.receive(data, host.time)
        host.pass_on(0.002)
    host.pass_on(0.02)
    assert set(host.vehicle.commands) == {(0.0, 0.0)}
    assert host.of(Sensors)


# ------------------------------------------------------------------------ faults


def test_a_reboot_stops_it_and_resets_its_clock_and_counts(host):
    host.vehicle.angles = (3.0, 4.0)
    host.pass_on(0.3)
    host.send(FrameType.DRIVE, DriveCommand(300, 300).pack())
    host.emulator.reboot(host.time, Reset.WATCHDOG)
    assert host.vehicle.commands[-1] == (0.0, 0.0)
    assert host.send(FrameType.DRIVE, DriveCommand(100, 100).pack())[0]  # while it boots: unheard
    assert host.vehicle.commands[-1] == (0.0, 0.0)
    before = len(host.got)
    host.pass_on(0.2)
    assert isinstance(host.got[before], Hello)
    assert (host.got[before].boots, host.got[before].reset) == (2, Reset.WATCHDOG)
    sensors = host.of(Sensors)[-1]
    assert sensors.clock < 250_000
    assert sensors.counts == pytest.approx((0, 0), abs=3)
    assert sensors.voltages == pytest.approx((3.0 / STEP, 4.0 / STEP), abs=3)
    assert host.counts["restarted"] == 1
    assert "lost" not in host.counts


def test_a_stall_and_a_low_supply_are_reported(host):
    host.vehicle.stalled = (False, True)
    host.emulator.low_supply = True
    host.pass_on(0.02)
    assert host.of(Sensors)[-1].flags == Flag.DEAD_MAN | Flag.STALL_RIGHT | Flag.LOW_SUPPLY
