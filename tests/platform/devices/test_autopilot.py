"""The driver with the emulated firmware: readings, commands, and faults."""

import contextlib
import math
import os
import struct
import subprocess
import sys
import threading
import time
import tty

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.platform.devices.autopilot_bench import RADIUS, TICK, Bench, Vehicle

from impslam.component import components
from impslam.platform.devices.autopilot import Autopilot
from impslam.platform.devices.autopilot_messages import FROM_AUTOPILOT, FrameType
from impslam.platform.devices.framing import Decoder, Encoder
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.types import (
    Acceleration,
    Climate,
    DeviceTime,
    EncoderVoltages,
    Imu,
    MagneticField,
    WheelAngles,
)

STEP = 2 * math.pi / 4096


@pytest.fixture
def bench(monkeypatch):
    return Bench(monkeypatch)


# ------------------------------------------------------------------------ what it delivers


def test_all_sensors_are_delivered_at_their_rates_in_si_units(bench):
    bench.run(5.0)
    health = bench.health
    assert health.state == "ok"
    assert health.detail == "firmware 1.0, boot 1 (power) at bench"
    for kind in (WheelAngles, EncoderVoltages, Imu, Acceleration, MagneticField, DeviceTime):
        assert 490 <= len(bench.messages(kind)) <= 496
    assert 5 <= len(bench.messages(Climate)) <= 6
    imu, second = bench.messages(Imu)[100], bench.messages(Acceleration)[100]
    np.testing.assert_allclose(imu.angular_velocity, [0.01, -0.02, 0.5], atol=2e-4)
    np.testing.assert_allclose(imu.linear_acceleration, [0.1, -0.2, 9.81], atol=1e-3)
    np.testing.assert_allclose(second.linear_acceleration, [0.1, -0.2, 9.81], atol=0.2)
    field = np.mean([m.field for m in bench.messages(MagneticField)], axis=0)
    north = [20e-6 * math.cos(0.5), -20e-6 * math.sin(0.5), -45e-6]
    np.testing.assert_allclose(field, north, atol=1e-7)
    assert bench.messages(Climate)[0].temperature == pytest.approx(23.0, abs=0.1)
    assert bench.messages(Climate)[0].humidity == pytest.approx(0.45, abs=0.01)


def test_no_frame_is_lost_on_a_clean_line(bench):
    bench.run(20.0)
    counts = bench.health.counts
    # 19.95 s of SENSORS, a HELLO a second, and two times set: an ACK and a HELLO for each.
    assert counts["frames"] == pytest.approx(1995 + 20 + 4, abs=3)
    assert not {"lost", "corrupt", "late", "repeated", "refused", "reboots"} & set(counts)


def test_wheel_angles_and_voltages_match_the_wheels(bench):
    bench.drive_on(0.4, 0.3, 6.0)
    bench.run(6.0)
    left, right = bench.messages(WheelAngles)[-1].left, bench.messages(WheelAngles)[-1].right
    # Of the last reading, up to 10 ms and a delay ago.
    speeds = np.array(bench.driver.wheel_speeds(0.4, 0.3)) / RADIUS
    np.testing.assert_allclose([left, right], bench.vehicle.angles, atol=0.015 * speeds.max())
    voltages = bench.messages(EncoderVoltages)[-1]
    turn = 5.0 / (2 * math.pi)
    assert voltages.left == pytest.approx(left * turn % 5.0, abs=0.004)
    assert voltages.right == pytest.approx(right * turn % 5.0, abs=0.004)


def test_stamps_increase_and_match_the_sampling_times(bench):
    bench.run(12.0)
    stamps = np.array([m.stamp for m in bench.messages(DeviceTime)])
    clocks = np.array([m.device_stamp for m in bench.messages(DeviceTime)])
    assert np.all(np.diff(stamps) > 0.0)
    truth = 1.7e9 + clocks / (1 + 50e-6)  # the clock runs since 0
    late = stamps - truth
    assert np.all(np.abs(late[1000:] - TICK) < 2e-4)  # the minimum delay of the bench
    arrived = np.array([r.arrived for r in bench.readings if isinstance(r.message, DeviceTime)])
    assert np.all(arrived - stamps > -1e-4)
    assert all(
        r.device_stamp == r.message.device_stamp
        for r in bench.readings
        if isinstance(r.message, DeviceTime)
    )


def test_the_min_delay_is_subtracted_from_stamps(monkeypatch):
    stamps = []
    for min_delay in (0.0, 0.25):
        bench = Bench(monkeypatch)
        bench.driver = bench.driver.model_copy(update={"min_delay": min_delay})
        bench.driver.model_post_init(None)
        bench.driver._receiver = bench._receive
        bench.run(1.0)
        stamps.append(bench.messages(Imu)[50].stamp)
    assert stamps[0] - stamps[1] == pytest.approx(0.25, abs=1e-6)


# ------------------------------------------------------------------------ driving


@given(st.floats(-2, 2), st.floats(-5, 5))
def test_wheel_speeds_keep_to_the_curve_and_below_the_top_speed(speed, turn_rate):
    driver = Autopilot(top_speed=0.8)
    left, right = driver.wheel_speeds(speed, turn_rate)
    assert max(abs(left), abs(right)) <= 0.8 + 1e-12
    wide = driver.skid * driver.track
    forward, turn = (left + right) / 2, (right - left) / wide
    assert forward * turn_rate == pytest.approx(turn * speed, abs=1e-9)
    assert forward * speed >= 0.0
    if abs(speed) + abs(turn_rate) * wide / 2 <= 0.8:
        assert (forward, turn) == pytest.approx((speed, turn_rate), abs=1e-12)


@pytest.mark.parametrize("command", [(math.nan, 0.0), (0.0, math.inf)])
def test_commands_that_are_not_finite_are_refused(command):
    with pytest.raises(ValueError, match="not finite"):
        Autopilot().drive(*command)


def test_a_drive_reaches_the_motors_at_once_and_times_out(bench):
    bench.later(1.0, lambda: bench.driver.drive(0.3, 0.0))
    bench.run(3.0)
    (begin, *speeds), (end, *stand) = bench.vehicle.commands[-2:]
    assert begin == pytest.approx(1.0, abs=0.002)
    assert speeds == [0.3, 0.3]
    assert stand == [0.0, 0.0]
    assert end - begin == pytest.approx(0.5, abs=0.002)
    assert bench.events[1:] == ["no command for 0.5 s, motors off"]


def test_round_trips_are_measured(bench):
    assert all(math.isnan(value) for value in bench.driver.latency())
    bench.drive_on(0.1, 0.0, 4.0)
    bench.run(5.0)
    median, high = bench.driver.latency()
    assert 0.5e-3 < median < 5e-3
    assert median <= high < 0.02
    assert bench.health.counts["commands"] == 80  # 79 drives after the port is open, one time


def test_drives_are_ignored_from_a_stop_until_the_release(bench):
    bench.drive_on(0.3, 0.0, 4.0)
    bench.later(1.01, bench.driver.emergency_stop)
    bench.later(3.01, bench.driver.release)
    bench.run(4.0)
    moving = [t for t, left, _ in bench.vehicle.commands if left > 0]
    assert not [t for t in moving if 1.011 < t < 3.01]
    assert [t for t in moving if t > 3.01]
    stopped = [t for t, left, _ in bench.vehicle.commands if left == 0.0]
    assert any(abs(t - 1.01) < 0.003 for t in stopped)
    counts = bench.health.counts
    assert counts["drive held back"] == 40
    assert "emergency stop is active" in bench.events
    assert "emergency stop released" in bench.events


def test_a_stop_is_repeated_until_it_is_answered(bench):
    bench.drive_on(0.3, 0.0, 1.0)
    bench.later(0.9, lambda: setattr(bench, "spoil_commands", lambda data: b"\0"))
    bench.later(1.0, bench.driver.emergency_stop)
    bench.later(1.24, lambda: setattr(bench, "spoil_commands", lambda data: data))
    bench.run(3.6)
    assert bench.vehicle.commands[-1][1:] == (0.0, 0.0)
    assert bench.vehicle.commands[-1][0] == pytest.approx(1.27, abs=0.03)
    assert bench.health.counts["commands"] == pytest.approx(26, abs=2)  # it does not continue
    assert bench.health.counts["commands unanswered"] in {6, 7}  # 5 stops, and drives before


def test_an_old_answer_does_not_confirm_a_new_stop(bench):
    link, stops = bench.driver._link, []

    def without_second_stop(data):
        stops.extend(Decoder({FrameType.STOP}, lambda *_: None).feed(data))
        return b"" if len(stops) == 2 else data

    def stop_release_stop():
        bench.spoil_commands = without_second_stop
        bench.driver.emergency_stop()
        bench.driver.release()
        bench.driver.emergency_stop()  # lost, while the answer to the first is under way

    pending = []
    bench.later(1.0, stop_release_stop)
    bench.later(1.04, lambda: pending.append(link._pending))
    bench.run(2.0)
    assert pending == [FrameType.STOP]
    assert len(stops) == 3
    assert link._pending is None
    assert bench.events[-1] == "emergency stop is active"


def test_after_a_reboot_the_stop_is_sent_again(bench):
    bench.later(1.0, bench.driver.emergency_stop)
    bench.later(2.0, lambda: bench.emulator.reboot(bench.time))
    bench.run(3.0)
    assert bench.health.counts["stop demanded again"] == 1
    last = max(i for i, text in enumerate(bench.events) if text == "emergency stop is active")
    assert bench.events.index("rebooted: firmware 1.0, boot 2 (brown-out)") < last
    assert bench.emulator._state == 1


def test_commands_to_a_lost_autopilot_are_counted_and_do_not_wait(monkeypatch):
    driver = Autopilot(port="nowhere")
    begin = time.monotonic()
    driver.drive(0.1, 0.0)
    driver.emergency_stop()
    assert time.monotonic() - begin < 0.1
    assert driver.health().counts["commands not sent"] == 2


def test_a_port_that_takes_nothing_is_reopened(bench):
    bench.drive_on(0.1, 0.0, 3.0)
    bench.later(1.0, lambda: setattr(bench, "blocked", True))
    bench.later(1.6, lambda: setattr(bench, "blocked", False))
    bench.run(3.0)
    assert bench.closed >= 2
    assert bench.health.state == "ok"
    assert bench.health.counts["commands not sent"] > 3
    assert bench.vehicle.commands[-1][1] == 0.1


# ------------------------------------------------------------------------ what it survives


def test_an_unplug_loses_only_what_was_sent_meanwhile_and_counts_it(bench):
    bench.drive_on(0.3, 0.1, 6.0)
    bench.later(2.0, lambda: setattr(bench, "plugged", False))
    bench.later(3.3, lambda: setattr(bench, "plugged", True))
    bench.run(6.0)
    counts = bench.health.counts
    assert bench.health.state == "ok"
    gap = np.max(np.diff([m.stamp for m in bench.messages(Imu)]))
    assert 1.3 < gap < 2.0
    # An ACK too for what was under way, and HELLOs.
    assert counts["lost"] == pytest.approx(100 * gap, abs=6)
    assert counts["WheelAngles"] + counts["lost"] == pytest.approx(595, abs=10)
    angles = bench.messages(WheelAngles)
    speeds = np.array(bench.driver.wheel_speeds(0.3, 0.1)) / RADIUS
    assert angles[-1].left == pytest.approx(bench.vehicle.angles[0], abs=0.02 * speeds[0])
    assert angles[-1].right == pytest.approx(bench.vehicle.angles[1], abs=0.02 * speeds[1])
    assert "reboots" not in counts


def test_silence_is_counted_and_notified_and_reopens_the_port(bench):
    healths = []
    bench.later(2.0, lambda: setattr(bench, "spoil", lambda data: b""))
    bench.later(3.5, lambda: healths.append(bench.health))
    bench.later(4.2, lambda: healths.append(bench.health))
    bench.later(7.0, lambda: setattr(bench, "spoil", lambda data: data))
    bench.run(12.0)
    silent, lost = healths
    assert silent.state == "silent"
    assert silent.counts["silences"] == 1
    assert lost.state == "lost"
    assert "no valid message for 2.0 s" in lost.detail
    assert bench.health.state == "ok"
    assert bench.closed == 3


def test_a_wrong_baud_rate_or_another_device_is_reported(bench):
    rng = np.random.default_rng(1)
    bench.spoil = lambda data: rng.integers(0, 256, len(data), np.uint8).tobytes()
    bench.run(3.0)
    assert bench.health.state == "lost"
    assert "baud" in bench.health.detail
    assert bench.readings
    assert not bench.messages(WheelAngles)
    assert bench.health.counts["corrupt"] > 10


def test_an_autopilot_without_hello_is_reported(bench):
    def without_hello(data):
        return b"".join(piece + b"\0" for piece in data.split(b"\0")[:-1] if len(piece) in {68, 20})

    bench.spoil = without_hello
    bench.run(2.2)
    assert "no HELLO" in bench.health.detail
    assert not bench.messages(WheelAngles)
    assert bench.health.counts["before HELLO"] > 150


@pytest.mark.parametrize("seed", range(6))
def test_wheel_angles_continue_across_reboots_to_the_step(monkeypatch, seed):
    bench = Bench(monkeypatch, seed=seed)
    rng = np.random.default_rng(seed)
    bench.drive_on(rng.uniform(-0.4, 0.4), rng.uniform(-1.0, 1.0), 9.0)
    for at in np.sort(rng.uniform(1.0, 8.5, 5)):
        bench.later(at, lambda: bench.emulator.reboot(bench.time))
    bench.run(10.0)
    angles = bench.messages(WheelAngles)[-1]  # it is stationary by now
    assert bench.health.counts["reboots"] == 5
    assert angles.left == pytest.approx(bench.vehicle.angles[0], abs=2 * STEP)
    assert angles.right == pytest.approx(bench.vehicle.angles[1], abs=2 * STEP)
    assert abs(angles.left) + abs(angles.right) > 2 * math.pi
    assert sum(text.startswith("rebooted") for text in bench.events) == 5
    stamps = np.array([m.stamp for m in bench.messages(WheelAngles)])
    assert np.all(np.diff(stamps) > 0.0)
    lefts = np.array([m.left for m in bench.messages(WheelAngles)])
    assert np.max(np.abs(np.diff(lefts))) < 0.15 * 1.0 / RADIUS


def test_a_reboot_under_the_same_boot_number_is_detected_by_the_clock(bench):
    bench.drive_on(0.3, 0.0, 3.0)

    def reset_link():
        bench.emulator._boots -= 1
        bench.emulator.reboot(bench.time)

    bench.later(2.0, reset_link)
    bench.run(4.0)
    assert bench.health.counts["reboots"] == 1
    assert bench.messages(WheelAngles)[-1].left == pytest.approx(
        bench.vehicle.angles[0], abs=2 * STEP
    )


def test_the_accumulators_may_wrap(bench):
    for accumulator in bench.emulator._accumulators:
        accumulator.count = 2**31 - 2000
    bench.drive_on(0.4, 0.0, 3.0)
    bench.run(4.0)
    wheels = bench.messages(WheelAngles)
    lefts = np.array([m.left for m in wheels])
    assert np.max(np.abs(np.diff(lefts))) < 0.1
    assert lefts[-1] == pytest.approx(bench.vehicle.angles[0], abs=2 * STEP)
    assert bench.emulator._accumulators[0].count > 2**31


def test_its_time_is_set_at_the_start_and_every_ten_seconds_and_after_a_reboot(bench):
    bench.later(14.0, lambda: bench.emulator.reboot(bench.time))
    bench.run(18.0)
    assert bench.health.counts["commands"] == 3
    hello = bench.driver._state.hello
    assert hello.host_offset * 1e-6 == pytest.approx(1.7e9 + 14.0, abs=0.01)


def test_changed_flags_are_notified(bench):
    bench.later(1.0, lambda: setattr(bench.vehicle, "stalled", (True, False)))
    bench.later(1.5, lambda: setattr(bench.vehicle, "stalled", (False, False)))
    bench.later(2.0, lambda: setattr(bench.emulator, "low_supply", True))
    bench.run(2.5)
    assert bench.events[-3:] == [
        "left motor stalls",
        "left motor turns again",
        "supply is low; charge the battery",
    ]


def test_wheels_that_stand_although_the_robot_is_driven_are_reported(bench):
    seen = {}
    for moment in (2.5, 4.5, 6.5, 8.0):
        bench.later(moment, lambda moment=moment: seen.update({moment: bench.driver.blockage}))
    bench.later(3.0, lambda: setattr(bench.vehicle, "blocked", True))
    bench.later(5.0, lambda: setattr(bench.vehicle, "blocked", False))
    bench.later(7.0, lambda: setattr(bench.vehicle, "blocked", True))  # it is not driven any more
    bench.drive_on(0.2, 0.3, 7.0)
    bench.run(9.0)
    assert {moment for moment, blockage in seen.items() if blockage} == {4.5}
    assert "the robot is blocked" in seen[4.5]
    assert [text for text in bench.events if "are driven" in text] == [seen[4.5]]


def test_motors_that_stall_are_a_hindrance(bench):
    bench.vehicle.stalled = (False, True)
    bench.run(1.0)
    assert bench.driver.blockage == "right motor stalls"


def test_a_clock_jump_is_notified_and_tracked(bench):
    def jump():
        bench.emulator._ready_at -= 3.0  # its clock is 3 s further

    bench.later(8.0, jump)
    bench.run(12.0)
    assert bench.health.counts["clock jumps"] == 1
    assert any("clock jumped" in text for text in bench.events)
    stamps = np.array([m.stamp for m in bench.messages(Imu)])
    arrived = np.array([r.arrived for r in bench.readings if isinstance(r.message, Imu)])
    assert np.all(np.diff(stamps) > 0.0)
    assert np.all(np.abs(arrived - stamps)[-300:] < 0.02)


def test_an_impossible_frame_is_counted_and_notified_once(bench):
    encoder = Encoder(77)
    bad = b"".join(
        encoder.encode(kind, struct.pack("<B", 9))[1] for kind in sorted(FROM_AUTOPILOT) * 2
    )
    bench.later(1.0, lambda: bench._under_way.append((bench.time, bad)))
    bench.run(2.0)
    assert bench.health.counts["refused"] == 6
    assert sum("check" in text or "bytes; it has" in text for text in bench.events) == 1
    assert bench.health.state == "ok"


@pytest.mark.parametrize("rate", [1e-4, 1e-3, 1e-2])
def test_on_a_noisy_line_every_frame_is_accounted_for_and_no_value_is_wrong(monkeypatch, rate):
    bench = Bench(monkeypatch)
    rng = np.random.default_rng(8)

    def noisy(data):
        bits = rng.random((len(data), 8)) < rate / 8
        return bytes(np.frombuffer(data, np.uint8) ^ np.packbits(bits))

    bench.spoil = bench.spoil_commands = noisy
    bench.drive_on(0.3, 0.0, 15.0)
    bench.run(16.0)
    bench.spoil = bench.spoil_commands = lambda data: data
    bench.run(1.0)
    counts = bench.health.counts
    sent = bench.emulator._encoder._next
    # A corrupt frame is counted as lost by the gap that it leaves.
    assert counts["frames"] + counts.get("lost", 0) == sent
    assert counts.get("lost", 0) == pytest.approx(sent * (1 - (1 - rate) ** 69), rel=0.25, abs=4)
    lefts = np.array([m.left for m in bench.messages(WheelAngles)])
    # Without a jump: 0.3 m/s for the longest gap there is.
    gap = np.max(np.diff([m.stamp for m in bench.messages(WheelAngles)]))
    assert np.max(np.abs(np.diff(lefts))) < 0.3 / RADIUS * gap + 40 * STEP
    assert lefts[-1] == pytest.approx(bench.vehicle.angles[0], abs=2 * STEP)


# ------------------------------------------------------------------------ on a real pseudo-terminal


def test_driver_and_emulator_talk_through_a_pseudo_terminal():
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    vehicle, ended, readings = Vehicle(), threading.Event(), []
    emulator = AutopilotEmulator(vehicle, drift=0.0, seed=1)
    begin = time.monotonic()

    def firmware():
        while not ended.wait(1e-3):
            moment = time.monotonic() - begin
            vehicle.advance(moment)
            with contextlib.suppress(BlockingIOError):
                emulator.receive(os.read(master, 4096), moment)
            os.write(master, emulator.due(moment))

    thread = threading.Thread(target=firmware)
    thread.start()
    driver = Autopilot(port=os.ttyname(slave))
    try:
        driver.start(readings.append)
        until = time.monotonic() + 10.0
        while time.monotonic() < until and driver.health().counts.get("commands", 0) < 12:
            if driver.health().state == "ok":
                driver.drive(0.2, 0.0)
            time.sleep(0.02)
        time.sleep(0.1)
        driver.stop()
    finally:
        ended.set()
        thread.join()
        os.close(master)
        os.close(slave)
    assert [r for r in readings if isinstance(r.message, WheelAngles)]
    assert any(left == 0.2 for _, left, _ in vehicle.commands)
    assert driver.health().state == "stopped"
    assert not math.isnan(driver.latency()[0])


def test_components_are_listed_without_the_robot_extra():
    code = (
        "import sys; sys.modules['serial'] = sys.modules['cobs'] = None\n"
        "from impslam.component import components\n"
        "print(components('device')['autopilot']().wheel_speeds(0.1, 0.0))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(0.1, 0.1)"


def test_it_is_registered():
    assert components("device")["autopilot"] is Autopilot


def test_an_earlier_stop_is_reported_until_it_is_released(bench):
    bench.driver.emergency_stop()
    bench.run(1.0)
    driver = Autopilot(port="bench", label="imp", min_delay=0.0)
    driver._stopping, driver._receiver = bench.driver._stopping, bench.driver._receiver
    bench.driver = driver  # another program; the micro-controller was on all the time
    bench.run(1.0)
    assert driver.stopped
    driver.release()
    assert not driver.stopped
    bench.run(1.0)
    assert not driver.stopped
    assert "emergency stop released" in bench.events


def test_a_silent_line_is_notified_once(bench):
    bench.spoil = lambda data: b""
    bench.run(30.0)
    notices = [text for text in bench.events if "no valid message" in text]
    assert len(notices) == 1
    assert bench.health.counts["lost connection"] == 1
    assert bench.health.counts["silences"] > 5  # it was opened as often
