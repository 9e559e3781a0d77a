"""The driver with the emulated sensor: states, faults, and stamps."""

import os
import socket
import threading
import time

import numpy as np
import pytest
from tests.platform.devices.urg_bench import HOST, Bench, Room, sensor

from impslam.platform.devices import scip_link, urg_clock
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.clock import DeviceClock
from impslam.platform.devices.scip_info import MeasurementParameters
from impslam.platform.devices.urg import Urg, is_rs232
from impslam.platform.devices.urg_beams import UrgBeams
from impslam.platform.devices.urg_clock import SweepTimes
from impslam.platform.virtual import urg_memory
from impslam.platform.virtual.urg import UrgEmulator
from impslam.types import DeviceTime, Event, LaserScan

URG = MeasurementParameters("URG-04LX", 20, 5600, 1024, 44, 725, 384, 600)
STREAM = b"MD0044072501000\n"


def true_begins(bench, room):
    """Return the true host times of the first beams of scans."""
    began = HOST + np.array(room.began)
    stamps = np.array([scan.stamp for scan in bench.scans])
    return began[np.abs(began[:, None] - stamps).argmin(0)]


# --------------------------------------------------------------------------- beams


def test_the_beams_of_a_urg_04lx():
    beams = UrgBeams.of(URG, "MD", (44, 725), 1, 0)
    assert beams.request == STREAM
    assert len(beams.angles) == 682
    assert beams.angles[0] == pytest.approx(-2.0862, abs=5e-5)
    assert beams.angles[-1] == pytest.approx(2.0923, abs=5e-5)
    assert beams.angles[384 - 44] == 0.0
    assert np.diff(beams.offsets) == pytest.approx(97.65625e-6)
    assert beams.delay == pytest.approx(4.296875e-3)
    assert beams.limits == (20, 5600)


def test_clusters_have_the_angle_of_their_middle():
    beams = UrgBeams.of(URG, "MS", (380, 388), 4, 2)
    assert beams.request == b"MS0380038804200\n"
    steps = beams.angles / (2 * np.pi / 1024) + 384
    np.testing.assert_allclose(steps, [381.5, 385.5, 388.0])
    assert beams.limits == (20, 4094)  # 4095 is what two characters say for all beyond


# --------------------------------------------------------------------------- the ordinary run


@pytest.mark.parametrize("mode", ["MD", "GD", "MS", "GS"])
def test_scans_match_the_room(monkeypatch, mode):
    emulator, room = sensor(drift=-80e-6, seed=1)
    bench = Bench(emulator, monkeypatch, stop_after=60, mode=mode)
    scans = bench.run()
    assert len(scans) == 60
    began = true_begins(bench, room)
    index = np.searchsorted(HOST + np.array(room.began), began - 1e-6)
    for scan, number in zip(scans, index, strict=True):
        expected = Room.of(int(number))
        far = expected > (4.094 if mode in ("MS", "GS") else 5.6)
        np.testing.assert_allclose(scan.ranges, np.where(far, 0.0, expected), atol=1e-9)
        assert scan.range_min == pytest.approx(0.02)
        assert scan.range_max == pytest.approx(4.094 if mode in ("MS", "GS") else 5.6)
    assert np.abs([scan.stamp for scan in scans] - began).max() < 2e-3
    assert bench.counts["LaserScan"] == bench.counts["DeviceTime"] == 60
    assert "missed scans" not in bench.counts
    assert bench.sent[-1] == b"QT\n"
    assert not emulator.laser


def test_its_health_shows_what_it_is(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, stop_after=1)
    bench.run()
    assert bench.events == [
        "SOKUIKI Sensor URG-04LX H0000000, firmware 3.3.00,06/Mar./2008: 682 beams at 10 Hz"
    ]


def test_steps_clusters_and_skips(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(
        emulator, monkeypatch, first_step=100, last_step=199, cluster=3, skip=1, stop_after=5
    )
    scans = bench.run()
    assert len(scans[0].angles) == 34
    assert np.diff([scan.stamp for scan in scans]) == pytest.approx(0.2, abs=2e-3)
    first = Room.of(0)[56:59]
    assert scans[0].ranges[0] == pytest.approx(first[first > 0].min())
    assert "missed scans" not in bench.counts


def test_both_clocks_are_kept(monkeypatch):
    emulator, _ = sensor(clock_start_ms=2**24 - 1000)
    bench = Bench(emulator, monkeypatch, stop_after=30)
    bench.run()
    times = [r for r in bench.readings if isinstance(r.message, DeviceTime)]
    scans = [r for r in bench.readings if isinstance(r.message, LaserScan)]
    device = np.array([r.message.device_stamp for r in times])
    assert np.diff(device) == pytest.approx(0.1)  # unwrapped
    assert device[0] < 2**24 * 1e-3 < device[-1]
    for told, scan in zip(times, scans, strict=True):
        assert told.message.device == "lidar"
        assert told.message.stamp == pytest.approx(scan.message.stamp - 44 * 0.1 / 1024)
        assert scan.device_stamp == pytest.approx(told.device_stamp + 44 * 0.1 / 1024)
        assert scan.arrived > scan.message.stamp + 0.066


# --------------------------------------------------------------------------- states it may be found in


@pytest.mark.parametrize(
    ("before", "options"),
    [
        (b"", {}),
        (b"", {"scip1": True}),
        (STREAM, {}),
        (b"MS0000076801000;other\n", {}),
        (b"TM0\n", {}),
        (b"BM\n", {}),
        (b"half a requ", {}),
        (b"\n\n\n\x00\xff\n", {}),
    ],
    ids=["idle", "scip 1.1", "streaming", "other stream", "adjusting", "laser", "half", "junk"],
)
def test_it_starts_from_any_state(monkeypatch, before, options):
    emulator, _ = sensor(**options)
    emulator.receive(before, 0.0)
    bench = Bench(emulator, monkeypatch, stop_after=3)
    bench.wait(0.85)
    scans = bench.run()
    assert len(scans) == 3
    assert bench.time < 4.0


def test_an_absent_sensor_is_an_error(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, spoil=lambda _: b"")
    with pytest.raises(DeviceError, match="bench: no SCIP device answers; check"):
        bench.run()


def test_steps_that_it_does_not_measure_are_refused(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, first_step=10)
    with pytest.raises(DeviceError, match=r"steps 10 to 725 lie outside .* within 44 to 725"):
        bench.run()


@pytest.mark.parametrize("line", [b"ARES:1024;\\", b"AMAX:725;o", b"SCAN:600;e"])
def test_impossible_parameters_are_an_error(monkeypatch, line):
    key = line[:5]
    hostile = key + b"0;" + bytes([(sum(key + b"0") & 0x3F) + 0x30])
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, spoil=lambda data: data.replace(line, hostile))
    with pytest.raises(DeviceError, match="is it a SCIP"):
        bench.run()
    assert bench.scans == []


def test_parameters_are_accepted_when_two_answers_agree(monkeypatch):
    """A change that the checksum does not detect: 44 to 35 with the same sum."""
    emulator, _ = sensor()
    damaged = iter([True])

    def spoil(data):
        if b"AMIN:44;7" in data and next(damaged, False):
            return data.replace(b"AMIN:44;7", b"AMIN:53;7")
        return data

    bench = Bench(emulator, monkeypatch, stop_after=2, spoil=spoil)
    assert len(bench.run()[0].angles) == 682
    assert bench.sent.count(b"PP\n") == 3


def test_an_rs232_line_is_found_and_made_faster(monkeypatch):
    emulator, _ = sensor(serial=19200)
    bench = Bench(emulator, monkeypatch, stop_after=3, cluster=4)
    monkeypatch.setattr("impslam.platform.devices.urg_start.BIT_RATES", (19200, 115200))
    monkeypatch.setattr("impslam.platform.devices.urg.is_rs232", lambda _: True)

    def matched(data):
        """At a wrong bit rate, bytes are garbled; SS is answered at the old one."""
        fits = bench.baudrate == emulator.bit_rate or data.startswith(b"SS")
        return data if fits else b"\xe0" * len(data)

    read, write = bench.read, bench.write
    monkeypatch.setattr(scip_link, "read_some", lambda port, wait: matched(read(port, wait)))
    monkeypatch.setattr(scip_link, "write_all", lambda port, data: write(port, matched(data)))
    assert len(bench.run()) == 3
    assert b"SS115200\n" in bench.sent
    assert bench.baudrate == emulator.bit_rate == 115200


def test_a_line_slower_than_the_scans_is_warned_of(monkeypatch):
    emulator, _ = sensor(serial=115200)
    bench = Bench(emulator, monkeypatch, stop_after=5)
    monkeypatch.setattr("impslam.platform.devices.urg.is_rs232", lambda _: True)
    bench.run()
    assert any("a scan takes 186 ms at 115200 bit/s" in text for text in bench.events)
    assert bench.counts["missed scans"] == 4  # every second one


def instead(old, new):
    """Replace an answer."""
    return lambda data: data.replace(old, new)


def test_the_bit_rate_stays_if_a_change_is_refused(monkeypatch):
    emulator, _ = sensor(serial=115200)
    spoil = instead(b"SS250000\n00P", b"SS250000\n04T")
    bench = Bench(emulator, monkeypatch, stop_after=2, baud=250000, spoil=spoil)
    monkeypatch.setattr("impslam.platform.devices.urg.is_rs232", lambda _: True)
    assert len(bench.run()) == 2
    assert bench.baudrate == 115200
    assert bench.events[0] == "stays at 115200 bit/s: this model's bit rate cannot be set"


def test_a_sensor_in_update_mode_is_reset_and_reported(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, spoil=instead(b"QT\n00P", b"QT\n0Ii"))
    with pytest.raises(DeviceError, match="firmware update mode"):
        bench.run()
    assert b"RS\n" in bench.sent


def test_a_refused_scan_command_is_reported_in_words(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, spoil=instead(STREAM + b"00P", STREAM + b"04T"))
    with pytest.raises(DeviceError, match="bench: MD: the last step is out of range"):
        bench.run()


def test_a_sensor_without_tm_is_stamped_by_arrival(monkeypatch):
    emulator, room = sensor()
    monkeypatch.delitem(urg_memory.COMMANDS, "TM")
    bench = Bench(emulator, monkeypatch, stop_after=30)
    stamps = np.array([scan.stamp for scan in bench.run()])
    assert bench.events[0] == "its clock cannot be read: it does not know this command"
    late = stamps - true_begins(bench, room)
    assert 1e-3 < late.mean() < 5e-3  # by the sensor's 2 ms and the way


def test_a_bad_state_of_the_sensor_is_notified(monkeypatch):
    emulator, _ = sensor()
    state = b"STAT:Motor tired"
    told = state + b";" + bytes([(sum(state) & 0x3F) + 0x30])
    spoil = instead(b"STAT:Sensor works well.;8", told)
    bench = Bench(emulator, monkeypatch, stop_after=1, spoil=spoil)
    bench.run()
    assert bench.events[0] == "the sensor reports: Motor tired"


@pytest.mark.parametrize(
    ("url", "answer"),
    [
        ("/dev/ttyUSB0", True),
        ("/dev/ttyS1", True),
        ("COM3", True),
        ("/dev/ttyACM0", False),
        ("socket://192.168.0.10:10940", False),
        ("/dev/pts/4", False),
    ],
)
def test_which_ports_have_a_bit_rate(url, answer):
    assert is_rs232(url) == answer


# --------------------------------------------------------------------------- faults


def test_a_malfunction_is_reset_and_measuring_goes_on(monkeypatch):
    emulator, room = sensor()
    bench = Bench(emulator, monkeypatch, stop_after=40)
    bench.at = [(1.5, lambda: emulator.fail(53))]
    scans = bench.run()
    assert len(scans) == 40
    assert b"RS\n" in bench.sent
    assert bench.counts["malfunctions"] == bench.counts["interruptions"] == 1
    assert any("hardware trouble" in text and "status 53" in text for text in bench.events)
    gaps = np.diff([scan.stamp for scan in scans])
    assert gaps.min() > 0.09
    assert gaps.max() < 0.5  # recovery takes less
    assert np.abs([scan.stamp for scan in scans] - true_begins(bench, room)).max() < 2e-3


def test_a_laser_that_cannot_be_switched_on_is_reset(monkeypatch):
    emulator, _ = sensor()
    emulator.fail(60)
    bench = Bench(emulator, monkeypatch, mode="GD", stop_after=3)
    assert len(bench.run()) == 3
    assert any("a malfunction keeps the laser off" in text for text in bench.events)


def test_a_lasting_malfunction_is_raised(monkeypatch):
    emulator, _ = sensor()
    emulator.fail(77, lasting=True)
    bench = Bench(emulator, monkeypatch)
    with pytest.raises(DeviceError, match="status 77"):
        bench.run()
    assert bench.sent.count(b"RS\n") == 2
    assert bench.time < 5.0


def test_the_verification_of_an_error_is_awaited(monkeypatch):
    emulator, _ = sensor()
    bench = Bench(emulator, monkeypatch, stop_after=20)
    bench.at = [(1.0, lambda: emulator.fail(21))]
    assert len(bench.run()) == 20
    assert "interruptions" not in bench.counts
    assert bench.counts["missed scans"] in range(9, 13)  # of a second
    assert bench.events[1:] == [
        "it has stopped to verify an error (status 21)",
        "it resumes: the laser works normally",
    ]


def test_a_sensor_that_reboots_is_started_again(monkeypatch):
    emulator, room = sensor(scip1=True, clock_start_ms=7_000_000)
    bench = Bench(emulator, monkeypatch, stop_after=40)
    bench.at = [(3.0, lambda: emulator.reboot(bench.time))]
    scans = bench.run()
    assert len(scans) == 40
    assert bench.counts["interruptions"] == 1
    assert any("no scan for 1.0 s" in text for text in bench.events)
    stamps = np.array([scan.stamp for scan in scans])
    assert (np.diff(stamps) > 0.09).all()
    assert np.abs(stamps - true_begins(bench, room)).max() < 2e-3
    assert np.diff(stamps).max() < 4.0  # the timeout, the boot, and the start from SCIP 1.1


def test_a_motor_faster_than_nominal(monkeypatch):
    emulator, room = sensor(turn=0.098)
    bench = Bench(emulator, monkeypatch, stop_after=120)
    bench.spoil = lambda data: b"" if 6.0 < bench.time < 9.1 else data
    with pytest.raises(DeviceError, match="no SCIP device"):
        bench.run()
    bench.wait(0.5)  # the thread reopens it
    stamps = np.array([scan.stamp for scan in bench.run()])
    assert np.abs(stamps - true_begins(bench, room)).max() < 2e-3
    assert bench.counts["missed scans"] == round(float(np.diff(stamps).max()) / 0.098) - 1 > 25


def test_a_clock_jump_restarts_the_synchronisation(monkeypatch):
    emulator, room = sensor()
    bench = Bench(emulator, monkeypatch, stop_after=40)
    jump = 3_600_000

    def leap():
        emulator._sensor._clock_start += jump

    bench.at = [(2.0, leap)]
    scans = bench.run()
    assert bench.counts["implausible stamps"] == 3
    assert any("clock has jumped" in text for text in bench.events)
    assert np.abs([scan.stamp for scan in scans] - true_begins(bench, room)).max() < 2e-3


def test_delayed_scans_have_the_stamps_of_their_measurement(monkeypatch):
    """The host sleeps for 3 s; buffered bytes then arrive at once."""
    emulator, room = sensor()
    bench = Bench(emulator, monkeypatch, stop_after=80)
    bench.at = [(4.0, lambda: bench.wait(3.0))]
    scans = bench.run()
    assert len(scans) == 80
    assert "implausible stamps" not in bench.counts
    assert "missed scans" not in bench.counts
    assert np.abs([scan.stamp for scan in scans] - true_begins(bench, room)).max() < 2e-3


@pytest.mark.parametrize(
    ("fault", "at_most"),
    [
        (lambda emulator, _: emulator.fail(53), 0.35),
        # A second of verifying, and the sweep that it began in.
        (lambda emulator, _: emulator.fail(21), 1.25),
        # Silence for the timeout, then the start; it has booted meanwhile.
        (lambda emulator, time: emulator.reboot(time), 1.3),
        # Another program stops it.
        (lambda emulator, time: emulator.receive(b"QT\n", time), 1.3),
        (lambda emulator, time: emulator.receive(b"RS\n", time), 1.4),
        (lambda emulator, time: emulator.receive(b"TM0\n", time), 1.4),
    ],
    ids=["malfunction", "verifying", "reboot", "stopped", "reset", "adjusting"],
)
def test_a_hundred_faults(monkeypatch, fault, at_most):
    """Recovery is bounded, stamps stay right and increase, and every lost scan is counted."""
    emulator, room = sensor(seed=9)
    bench = Bench(emulator, monkeypatch, stop_after=10_000)
    moments = 3.0 + np.cumsum(bench.rng.uniform(1.5, 2.1, 100))
    bench.at = [(float(m), lambda: fault(emulator, bench.time)) for m in moments]
    bench.end = moments[-1] + 3.0
    stamps = np.array([scan.stamp for scan in bench.run()])
    assert np.abs(stamps - true_begins(bench, room)).max() < 2e-3
    gaps = np.diff(stamps)
    assert gaps.min() > 0.09
    assert gaps.max() < at_most
    assert (gaps > 0.11).sum() == 100
    missed = np.maximum(0, np.rint(gaps / 0.1) - 1).sum()
    assert bench.counts["missed scans"] == missed


def noise(rate, seed):
    """Bytes are changed, dropped, doubled and inserted, each at a rate per byte."""
    rng = np.random.default_rng(seed)

    def spoil(data):
        out = bytearray()
        luck = rng.random((len(data), 4)) < rate
        for byte, (flip, lose, double, insert) in zip(data, luck, strict=True):
            if lose:
                continue
            out += bytes([byte ^ int(rng.integers(1, 256)) if flip else byte]) * (
                2 if double else 1
            )
            if insert:
                out.append(int(rng.integers(256)))
        return bytes(out)

    return spoil


@pytest.mark.parametrize("rate", [1e-5, 1e-4, 1e-3])
def test_no_damaged_scan_is_delivered_and_every_loss_is_counted(monkeypatch, rate):
    emulator, room = sensor(seed=3)
    bench = Bench(emulator, monkeypatch, stop_after=150, seconds=60.0, spoil=noise(rate, 8))
    try:
        scans = bench.run()
    except DeviceError:
        scans = bench.scans  # too much noise to start; the thread retries
    began = true_begins(bench, room)
    index = np.searchsorted(HOST + np.array(room.began), began - 1e-6)
    for scan, number in zip(scans, index, strict=True):
        np.testing.assert_allclose(scan.ranges, Room.of(int(number)), atol=1e-9)
    assert (np.diff(index) > 0).all()
    counts = bench.counts
    if "interruptions" not in counts and scans:
        assert int(index[-1] - index[0]) + 1 == len(scans) + counts.get("missed scans", 0)


def test_random_bytes_instead_of_a_sensor(monkeypatch):
    rng = np.random.default_rng(2)
    emulator, _ = sensor()
    junk = np.frombuffer(b"0123456789MDQTP\n\n\n\n;bZ~\x00\xff", np.uint8)
    bench = Bench(
        emulator, monkeypatch, spoil=lambda _: rng.choice(junk, int(rng.integers(0, 40))).tobytes()
    )
    with pytest.raises(DeviceError):
        bench.run()
    assert bench.scans == []
    assert bench.counts["damaged responses"] > 0


# --------------------------------------------------------------------------- time alone


def arrivals(number, drift, rng, wrap_at=0, period=0.1, least=0.073):
    """Return device stamps (raw ms) and arrivals of a sensor with a drifting clock and a tail of delays."""
    true = period * np.arange(number) + 0.0371
    raw = (np.floor(1e3 * (1.0 + drift) * true).astype(int) + wrap_at) % 2**24
    return (
        true,
        raw,
        true + least + rng.exponential(4e-4, number) + 0.05 * (rng.random(number) < 0.01),
    )


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 100e-6])
def test_stamps_stay_right_over_a_long_run(drift, rng):
    """Ten minutes over a wrap of the clock."""
    true, raw, arrived = arrivals(6000, drift, rng, wrap_at=2**24 - 200_000)
    times = SweepTimes(DeviceClock(), 0.1, 0.0708)
    for k in range(10):
        sent = -0.05 + 0.0031 * k
        asked = sent + 4e-4 + float(rng.exponential(1e-4))
        told = (int(np.floor(1e3 * (1.0 + drift) * asked)) + 2**24 - 200_000) % 2**24
        times.synchronise(told, HOST + sent, HOST + asked + 4e-4 + float(rng.exponential(1e-4)))
    errors, device = [], []
    for stamp, raw_stamp, moment in zip(true, raw, arrived, strict=True):
        assert times.is_plausible(int(raw_stamp), HOST + moment)
        unwrapped, host = times.place(int(raw_stamp), HOST + moment)
        errors.append(host - HOST - stamp)
        device.append(unwrapped)
    assert np.abs(errors).max() < 1.6e-3  # the clock is truncated to ms
    assert abs(np.mean(errors[100:])) < 1e-3
    assert np.diff(device) == pytest.approx(0.1, abs=1.1e-3)
    assert times.delay == pytest.approx(0.073, abs=1e-3)


def test_without_tm_the_initial_delay_is_used(rng):
    true, raw, arrived = arrivals(100, 0.0, rng)
    times = SweepTimes(DeviceClock(), 0.1, 0.0708)
    errors = [
        times.place(int(r), HOST + a)[1] - HOST - t
        for t, r, a in zip(true, raw, arrived, strict=True)
    ]
    assert np.abs(np.array(errors[20:]) - (0.073 - 0.0708)).max() < 1.5e-3


def test_an_implausible_answer_to_tm_is_ignored():
    times = SweepTimes(DeviceClock(), 0.1, 0.07)
    for raw, sent in ((1000, 0.0), (9000, 0.002), (900, 0.004), (1006, 0.006)):
        times.synchronise(raw, HOST + sent, HOST + sent + 1e-3)
    assert times.place(1106, HOST + 0.2) == (pytest.approx(1.106), pytest.approx(HOST + 0.1065))


@pytest.mark.parametrize(
    ("raw", "arrived", "plausible"),
    [
        (1200, 0.1, True),
        (1110, 0.1, False),  # no sweep is over so soon
        (1100, 0.1, False),  # the same again
        (1000, 0.1, False),  # back in time
        (1300, 0.1, True),  # one was missed, this one came soon
        (2200, 0.1, False),  # from the future
        (1200, 4.0, True),  # held up
        (1200, 20.0, False),
    ],
)
def test_which_stamps_are_plausible(raw, arrived, plausible):
    times = SweepTimes(DeviceClock(), 0.1, 0.07)
    times.place(1000, HOST - 0.1)
    times.place(1100, HOST)
    assert times.is_plausible(raw, HOST + arrived) == plausible


# --------------------------------------------------------------------------- real ports, real time


START = time.monotonic()


class Line(threading.Thread):
    """Carries bytes between an emulator and a file descriptor, in real time."""

    def __init__(self, emulator, read, write):
        super().__init__(daemon=True)
        self.emulator, self._read, self._write = emulator, read, write
        self.over = threading.Event()

    def run(self):
        while not self.over.wait(1e-3):
            moment = time.monotonic() - START
            try:
                if data := self._read():
                    self.emulator.receive(data, moment)
                if data := self.emulator.due(moment):
                    self._write(data)
            except OSError:
                return


def until(condition, seconds=15.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.01)


def over_pty(emulator):
    ours, theirs = os.openpty()
    os.set_blocking(ours, False)

    def read():
        try:
            return os.read(ours, 4096)
        except BlockingIOError:
            return b""

    return ours, theirs, Line(emulator, read, lambda data: os.write(ours, data))


def test_over_a_pseudo_terminal_until_it_is_unplugged():
    emulator = UrgEmulator(Room())
    ours, theirs, line = over_pty(emulator)
    readings = []
    device = Urg(port=os.ttyname(theirs), retry=0.05)
    line.start()
    try:
        device.start(readings.append)
        until(lambda: device.health().counts.get("LaserScan", 0) >= 5)
        assert device.health().state == "ok"
        assert "682 beams" in device.health().detail
        line.over.set()
        line.join()
        os.close(ours)
        until(lambda: device.health().state == "lost")
        assert device.health().counts["lost connection"] >= 1
        assert any(isinstance(r.message, Event) and r.message.level == "error" for r in readings)
    finally:
        device.stop()
        os.close(theirs)


# pyserial does not close a socket whose other end has gone; the collector does.
def test_over_tcp_through_an_unplug():
    emulator = UrgEmulator(Room())
    server = socket.create_server(("127.0.0.1", 0))
    lines = []

    def serve():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            connection.settimeout(1e-3)

            def read(connection=connection):
                try:
                    data = connection.recv(4096)
                except TimeoutError:
                    return b""
                if not data:
                    raise OSError
                return data

            line = Line(emulator, read, connection.sendall)
            line.connection = connection
            lines.append(line)
            line.run()
            connection.close()

    accepting = threading.Thread(target=serve, daemon=True)
    accepting.start()
    device = Urg(port=f"socket://127.0.0.1:{server.getsockname()[1]}", retry=0.05)
    try:
        device.start(lambda _: None)
        until(lambda: device.health().counts.get("LaserScan", 0) >= 3)
        lines[0].over.set()  # the plug
        until(lambda: len(lines) == 2)
        before = device.health().counts["LaserScan"]
        until(lambda: device.health().counts["LaserScan"] >= before + 3)
        assert device.health().state == "ok"
        assert device.health().counts["lost connection"] >= 1
        device.stop()
        until(lambda: not emulator.laser)
    finally:
        device.stop()
        server.shutdown(socket.SHUT_RDWR)
        server.close()
        for line in lines:
            line.over.set()
        accepting.join(2.0)


def test_learning_is_short_against_the_drift():
    """The drift at most bends the first scans' stamps by less than the clock's resolution."""
    assert urg_clock.LEARNING_SCANS * 0.1 * 100e-6 < 0.5 * urg_clock.UNIT
