"""The emulated URG-04LX follows the protocol, at the times of the real sensor."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.platform.devices import scip
from impslam.platform.devices.scip_encoding import decode, encode, with_checksum
from impslam.platform.virtual import urg, urg_memory
from impslam.platform.virtual.urg import UrgEmulator
from impslam.platform.virtual.urg_sensor import UrgSensor, clustered
from impslam.simulation.body import Body
from impslam.simulation.body_lidar import LidarSweeps
from impslam.simulation.world import World

STREAM = b"MD0044072501000\n"
TURN = 0.1
SWEPT = TURN * 725 / 1024  # from step 0 to the last that measures


class Room:
    """All beams have the same range, which may depend on the time of the sweep's first beam."""

    def __init__(self, read=lambda _: 1.234):
        self.read, self.began = read, []

    def ranges(self, time):
        self.began.append(time)
        return np.full(682, self.read(time))


class Talk:
    """Sends requests to an emulator and returns its answers as text."""

    def __init__(self, room=None, **options):
        self.room = room or Room()
        self.emulator = UrgEmulator(self.room, **options)
        self.time = 0.0

    def ask(self, request):
        self.emulator.receive(request.encode("latin-1") + b"\n", self.time)
        return self.hear(0.0)

    def hear(self, seconds):
        self.time += seconds
        return self.emulator.due(self.time).decode("latin-1")

    def arrivals(self, seconds, step=1e-3):
        """Return (time, text) of all answers within some seconds."""
        answers, end = [], self.time + seconds
        while self.time < end:
            if text := self.hear(step):
                answers.append((self.time, text))
        return answers


def distances(text, width=3):
    lines = text.rstrip("\n").split("\n")[3:]
    return decode("".join(line[:-1] for line in lines).encode("ascii"), width)


def stamp(text):
    return scip.stamp_of(text.split("\n")[2].encode("ascii"))


def test_parameters_as_the_protocols_text_prints_them():
    assert Talk().ask("PP") == (
        "PP\n00P\nMODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N\nDMIN:20;4\nDMAX:5600;_\n"
        "ARES:1024;\\\nAMIN:44;7\nAMAX:725;o\nAFRT:384;6\nSCAN:600;e\n\n"
    )


def test_version_and_state():
    talk = Talk()
    assert talk.ask("VV").startswith("VV\n00P\nVEND:Hokuyo Automatic Co.,Ltd.;[\n")
    answers = talk.ask("II;who")
    assert answers.startswith("II;who\n00P\n")
    assert "\nLASR:OFF;7\n" in answers
    assert "\nSTAT:Sensor works well.;8\n\n" in answers


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        ("XX", "0E"),
        ("", None),
        ("M", "0E"),
        ("MD00440725", "0C"),
        ("GD00440725011", "0E"),
        ("QT;12345678901234567", "0G"),
        ("QT;\t", "0H"),
        ("MDxxxx072501000", "01"),
        ("MD0044xxxx01000", "02"),
        ("MD00440725xx000", "03"),
        ("MD0044076901000", "04"),
        ("MD0044004301000", "05"),
        ("MD0044072501x00", "06"),
        ("MD00440725010xx", "07"),
        ("GDx044072501", "01"),
        ("GD0044x72501", "02"),
        ("GD00440725x1", "03"),
        ("GD0044999901", "04"),
        ("GD0044000001", "05"),
        ("GD0044072501", "10"),
        ("TM1", "04"),
        ("TM2", "03"),
        ("TM7", "01"),
        ("SSxxxxxx", "01"),
        ("SS123456", "02"),
        ("SS019200", "03"),
        ("CRxx", "01"),
        ("CR11", "02"),
        ("CR00", "03"),
        ("HS2", "01"),
        ("HS0", "02"),
        ("DB77", "01"),
        ("DB10", "03"),
        ("QT", "00"),
        ("BM", "00"),
        ("RS", "00"),
        ("SS115200", "00"),
        ("CR10", "00"),
        ("HS1", "00"),
        ("DB02", "00"),
        ("SCIP2.0", "0E"),
        ("SS11520²", "0E"),
    ],
)
def test_statuses(request_, status):
    answers = Talk().ask(request_)
    if status is None:
        assert answers == ""
    else:
        assert answers == f"{request_}\n{with_checksum(status.encode()).decode()}\n"


def test_the_laser_can_be_on_once():
    talk = Talk()
    assert talk.ask("BM") == "BM\n00P\n\n"
    assert talk.ask("BM") == "BM\n02R\n\n"
    assert talk.ask("QT") == "QT\n00P\n\n"
    assert not talk.emulator.laser


def test_a_scan_matches_a_response_by_hand():
    talk = Talk()
    talk.hear(0.05)
    talk.ask("BM")
    assert talk.ask("GD0383038501;a") == ""  # the laser has not made a turn yet
    assert talk.hear(0.12) == ""
    # The sweep of 0.1 to 0.2 s: stamp 100 = 1 * 64 + 36, "001T"; 1234 is "0CB" each. Sums:
    # 0x30 + 0x30 + 0x31 + 0x54 = 0xE5, 0x25 + 0x30 = "U"; 3 * 0xB5 = 0x21F, 0x1F + 0x30 = "O".
    assert talk.hear(0.02) == "GD0383038501;a\n00P\n001TU\n0CB0CB0CBO\n\n"
    assert talk.ask("GD0383038501").endswith("0CBO\n\n")  # again, at once


def test_sweeps_are_sent_when_they_have_ended():
    talk = Talk()
    assert talk.ask("MD0044072501000") == "MD0044072501000\n00P\n\n"
    answers = talk.arrivals(1.0)
    assert [text[:19] for _, text in answers] == ["MD0044072501000\n99b"] * len(answers)
    assert [stamp(text) for _, text in answers] == [100 * k for k in range(len(answers))]
    late = np.array([time for time, _ in answers]) - TURN * np.arange(len(answers)) - SWEPT
    assert len(answers) == 10
    assert late.min() >= urg.PROCESSING
    assert late.max() < urg.PROCESSING + 0.01
    np.testing.assert_allclose(
        talk.room.began, TURN * (np.arange(10) + 44 / 1024), atol=1e-9
    )  # step 44 is 4.3 ms after the stamp
    assert all(
        (distances(text) == 1234).all() and len(distances(text)) == 682 for _, text in answers
    )


def test_a_number_of_scans_is_counted_down_and_ends_with_the_laser_off():
    talk = Talk()
    talk.ask("MD0044072501003;x")
    answers = [text for _, text in talk.arrivals(1.0)]
    assert [text.split("\n")[0] for text in answers] == [
        "MD0044072501002;x",
        "MD0044072501001;x",
        "MD0044072501000;x",
    ]
    assert not talk.emulator.laser


def test_scans_are_skipped():
    talk = Talk()
    talk.ask("MD0044072501200")
    assert [stamp(text) for _, text in talk.arrivals(1.0)] == [0, 300, 600, 900]


def test_a_second_scan_command_is_refused_until_the_first_ends():
    talk = Talk()
    talk.ask("MD0044072501000")
    assert talk.ask("MD0044072501000").endswith("\n0Bb\n\n")
    assert talk.ask("QT") == "QT\n00P\n\n"
    assert talk.arrivals(0.5) == []


def test_invalid_distances_are_error_codes():
    talk = Talk(Room(lambda time: [0.0, 0.012, 5.7, 5.6, 0.02][round(time / TURN - 0.04)]))
    talk.ask("MD0000076801005")
    answers = [distances(text) for _, text in talk.arrivals(1.0)]
    assert [int(values[300]) for values in answers] == [0, 6, 0, 5600, 20]
    for values in answers:
        assert len(values) == 769
        assert (values[:44] == 19).all()
        assert (values[726:] == 19).all()


def test_two_characters_reach_to_4095():
    talk = Talk(Room(lambda time: 4.0 if time < TURN else 5.0))
    talk.ask("MS0044072501002")
    answers = [distances(text, 2) for _, text in talk.arrivals(0.5)]
    assert [int(values[0]) for values in answers] == [4000, 4095]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([30, 25, 40, 50, 45], [25, 40, 45]),
        ([0, 25, 6, 7, 1], [25, 6, 1]),
    ],
)
def test_a_cluster_gives_its_least_distance(values, expected):
    assert clustered(np.array(values), 2).tolist() == expected


def test_the_clock_wraps():
    talk = Talk(clock_start_ms=2**24 - 150)
    talk.ask("MD0044072501000")
    stamps = [stamp(text) for _, text in talk.arrivals(0.5)]
    assert stamps == [2**24 - 150, 2**24 - 50, 50, 150, 250]


def test_a_fast_clock_is_a_fast_motor():
    talk = Talk(drift=0.02)
    talk.ask("MD0044072501000")
    answers = talk.arrivals(5.0)
    assert [stamp(text) for _, text in answers] == [100 * k for k in range(len(answers))]
    assert len(answers) == 51  # 51 turns and a part of less than what a sweep takes; else 50


@pytest.mark.parametrize("drift", [0.0, 1e-4])
def test_the_body_gives_a_sweep_at_any_moment_after_its_end(drift):
    """Also just before a whole ms: the time of the body, which is rounded down, is then a ms behind."""
    robot = {"start": (0, 0, 0), "waypoints": [(1, 0)]}
    body, behind = Body(World.model_validate({"robot": robot})), 0.0
    sensor = UrgSensor(LidarSweeps(body), drift, 0, TURN)
    for microseconds in range(0, 1000, 2):
        sensor.reset(body.time + 1e-6 * microseconds)
        body.advance(sensor.end(0))
        behind = max(behind, sensor.end(0) - body.time)
        assert (sensor.values(0)[44:726] == 0).all()  # nothing is there
    assert behind > 0.998e-3


def test_time_adjustment():
    talk = Talk()
    talk.hear(1.0)
    assert talk.ask("TM0") == "TM0\n00P\n\n"
    assert talk.ask("TM0") == "TM0\n02R\n\n"
    assert talk.ask("TM1;a") == "TM1;a\n00P\n00?Xg\n\n"  # 1000 = 15 * 64 + 40
    assert talk.ask("QT") == "QT\n0Bb\n\n"
    assert talk.ask("TM2") == "TM2\n00P\n\n"
    assert talk.ask("QT") == "QT\n00P\n\n"


def test_scip_1_must_be_switched():
    talk = Talk(scip1=True)
    assert talk.ask("VV") == "VV\nE\n\n"
    assert talk.ask("SCIP2.0") == "SCIP2.0\n0\n\n"
    assert talk.ask("QT") == "QT\n00P\n\n"


def test_a_malfunction_lasts_until_reset():
    talk = Talk()
    talk.ask("MD0044072501000")
    talk.arrivals(0.3)
    talk.emulator.fail(53)
    assert talk.hear(0.0) == "MD0044072501000\n53X\n\n"
    assert talk.arrivals(0.5) == []
    assert not talk.emulator.laser
    assert talk.ask("BM") == "BM\n01Q\n\n"
    assert talk.ask("MD0044072501000") == "MD0044072501000\n53X\n\n"
    assert "Malfunction 53" in talk.ask("II")
    talk.ask("RS")
    assert talk.ask("BM") == "BM\n00P\n\n"


def test_a_lasting_malfunction_survives_a_reset():
    talk = Talk()
    talk.emulator.fail(60, lasting=True)
    talk.ask("RS")
    assert talk.ask("BM") == "BM\n01Q\n\n"
    talk.emulator.reboot(talk.time)
    talk.hear(1.0)
    assert talk.ask("BM") == "BM\n01Q\n\n"
    talk.emulator.repair()
    assert talk.ask("BM") == "BM\n00P\n\n"


def test_an_error_is_verified_and_scans_continue():
    talk = Talk()
    talk.ask("MD0044072501000")
    talk.arrivals(0.3)
    talk.emulator.fail(21)
    answers = [text for _, text in talk.arrivals(2.0)]
    assert [text.split("\n")[1] for text in answers] == ["21S", "98a"] + ["99b"] * (
        len(answers) - 2
    )
    assert len(answers) > 10


def test_a_reset_and_a_reboot_restart_the_clock():
    talk = Talk(clock_start_ms=5_000_000)
    talk.hear(10.0)
    talk.ask("RS")
    talk.ask("MD0044072501001")
    assert [stamp(text) for _, text in talk.arrivals(0.3)] == [0]
    talk.ask("MD0044072501000")
    talk.emulator.reboot(talk.time)
    assert talk.ask("QT") == ""  # it does not listen while it boots
    talk.hear(urg.BOOT_TIME)
    assert talk.ask("QT") == "QT\n00P\n\n"
    talk.ask("TM0")
    assert talk.ask("TM1").split("\n")[2][:4] == encode(np.array([500]), 4).decode()


def test_rs232_delays_bytes_and_scans_are_lost():
    talk = Talk(serial=115200)
    talk.ask("MD0044072501000")
    answers = talk.arrivals(2.0)
    size = len(answers[-1][1])
    took = np.diff([time for time, _ in answers[1:]])
    assert took.min() >= 10 * size / 115200
    assert all(np.diff([stamp(text) for _, text in answers[1:]]) == 200)  # 185 ms a scan
    assert talk.emulator.bit_rate == 115200
    talk.ask("RS")
    assert talk.emulator.bit_rate == 115200  # its initial value
    talk.ask("SS750000")
    assert talk.emulator.bit_rate == 750000


@settings(max_examples=60)
@given(st.lists(st.tuples(st.binary(max_size=40), st.floats(0.0, 0.3)), max_size=20))
def test_it_accepts_any_bytes(pieces):
    emulator, time = UrgEmulator(Room()), 0.0
    for data, pause in pieces:
        emulator.receive(data, time)
        time += pause
        emulator.due(time)
    emulator.receive(b"\nRS\nQT\n", time)
    assert emulator.due(time).endswith(b"RS\n00P\n\nQT\n00P\n\n")


@given(
    st.lists(st.sampled_from(sorted(urg_memory.COMMANDS)), max_size=12),
    st.text("0123456789x;", max_size=14),
)
def test_it_accepts_any_commands(commands, parameters):
    emulator, time = UrgEmulator(Room()), 0.0
    for command in commands:
        emulator.receive(
            f"{command}{parameters[: urg_memory.COMMANDS[command]]}\n".encode("ascii"), time
        )
        time += 0.13
        emulator.due(time)


def test_requests_may_be_cut_anywhere_and_end_in_cr():
    emulator = UrgEmulator(Room())
    for byte in b"TM0\r\nTM2\r":
        emulator.receive(bytes([byte]), 0.0)
    assert emulator.due(0.0) == b"TM0\n00P\n\nTM2\n00P\n\n"
