"""SCIP 2.0: characters, checksums, responses and statuses, with examples of the protocol."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.platform.devices import scip_noise

from impslam.platform.devices import scip, scip_status
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.scip import Splitter
from impslam.platform.devices.scip_encoding import (
    DamagedError,
    decode,
    encode,
    with_checksum,
    without_checksum,
)
from impslam.platform.devices.scip_info import MeasurementParameters, Version, fields, to_line

# As the protocol's text prints them; the checksums are Hokuyo's.
PP = (
    b"MODL:URG-04LX(Hokuyo Automatic Co.,Ltd.);N",
    b"DMIN:20;4",
    b"DMAX:5600;_",
    b"ARES:1024;\\",
    b"AMIN:44;7",
    b"AMAX:725;o",
    b"AFRT:384;6",
    b"SCAN:600;e",
)
VV = (
    b"VEND:Hokuyo Automatic Co.,Ltd.;[",
    b"PROD:SOKUIKI Sensor URG-04LX;[",
    b"FIRM:3.1.00(18/Jan./2007);`",
    b"PROT:SCIP 2.0;N",
    b"SERI:H0614967;V",
)
II = (b"LASR:OFF;7", b"MESM:IDLE;:", b"TIME:081615;N", b"STAT:Sensor works well.;8")


@pytest.mark.parametrize(
    ("value", "text"), [(1234, b"CB"), (5432, b"1Dh"), (16000000, b"m2@0")]
)  # sections 6.1 to 6.3
def test_the_protocols_own_encodings(value, text):
    assert encode(np.array([value]), len(text)) == text
    assert decode(text, len(text)).tolist() == [value]


@given(st.integers(1, 4), st.data())
def test_encoded_values_are_decoded(width, data):
    values = data.draw(st.lists(st.integers(0, 64**width - 1), max_size=70))
    array = np.array(values, dtype=np.int64)
    assert decode(encode(array, width), width).tolist() == values


@pytest.mark.parametrize("data", [b"0/", b"0p", b"0\n", b"000"])
def test_invalid_characters_are_refused(data):
    with pytest.raises(DamagedError):
        decode(data, 2)


def test_status_checksums():
    assert with_checksum(b"00") == b"00P\n"
    assert with_checksum(b"99") == b"99b\n"
    assert without_checksum(b"0Ee") == b"0E"
    with pytest.raises(DamagedError):
        without_checksum(b"00Q")
    with pytest.raises(DamagedError):
        without_checksum(b"P")


def test_requests():
    assert scip.request("VV") == b"VV\n"
    assert scip.request("TM", "1", "round 3") == b"TM1;round 3\n"
    assert scip.measure("MD", 44, 725) == b"MD0044072501000\n"
    assert scip.measure("MS", 44, 725, cluster=3, skip=2) == b"MS0044072503200\n"
    assert scip.measure("GD", 0, 768) == b"GD0000076801\n"
    for text in ("seventeen letters", "line\nfeed", "Grüße"):
        with pytest.raises(ValueError, match="at most 16 printable"):
            scip.request("VV", "", text)


@given(st.lists(st.integers(0, 30)))
def test_responses_are_found_however_the_bytes_are_cut(cuts):
    sent = b"QT\n00P\n\nTM1;a\n00P\n0001Q\n\nVV\n0Ee\n\n"
    splitter, found, start = Splitter(), [], 0
    for cut in (*cuts, len(sent)):
        found += splitter.feed(sent[start : start + cut])
        start += cut
    assert [scip.parse(raw) for raw in found] == [
        scip.Response("QT", "00", ()),
        scip.Response("TM1;a", "00", (b"0001Q",)),
        scip.Response("VV", "0E", ()),
    ]


def test_bytes_without_an_end_are_dropped():
    splitter = Splitter()
    for _ in range(40):
        assert splitter.feed(b"x" * 1000) == []
    assert splitter.dropped > 0
    assert splitter.feed(b"x\n\nQT\n00P\n\n")[-1] == b"QT\n00P"


@pytest.mark.parametrize(
    "raw", [b"", b"QT", b"QT\n", b"QT\n00", b"QT\n00Q", b"Q\xd4\n00P", b"\n00P"]
)
def test_broken_responses_are_damaged_or_answer_nothing(raw):
    try:
        assert scip.parse(raw).echo == ""
    except DamagedError:
        return


def test_the_switch_to_scip_2_is_answered_as_in_scip_1():
    assert scip.parse(b"SCIP2.0\n0") == scip.Response("SCIP2.0", "0", ())
    assert scip.parse(b"SCIP2.0\n0Ee").status == "0E"
    with pytest.raises(DamagedError):
        scip.parse(b"QT\n0")


# --------------------------------------------------------------------------- scans


def response(stamp, *lines):
    return scip.Response("MD", "99", (stamp, *lines))


def test_a_scan_read_by_hand():
    # 1Dh 5432, then 0CB 19 * 64 + 18 = 1234; sums: 0x31+0x44+0x68+0x30+0x43+0x42 = 0x192 -> 0x12.
    got = scip.sweep(response(b"m2@0?", b"1Dh0CBB"), 3, 2)
    assert got.stamp == 16000000
    assert got.values.tolist() == [5432, 1234]


@pytest.mark.parametrize("number", [1, 21, 22, 64, 128, 682])
def test_scans_come_in_lines_of_64(number):
    values = np.arange(number) * 5 + 20
    lines = scip.in_lines(encode(values, 3)).split(b"\n")[:-1]
    assert all(len(line) == 65 for line in lines[:-1])
    got = scip.sweep(response(b"00011", *lines), 3, number)
    assert got.values.tolist() == values.tolist()
    for wrong in (lines[:-1], [*lines, lines[-1]], [*lines[:-1], lines[-1][:-1]]):
        with pytest.raises(DamagedError):
            scip.sweep(response(b"00011", *wrong), 3, number)


@pytest.mark.parametrize("stamp", [b"", b"0001b", b"001A", b"000~N"])
def test_a_damaged_stamp_is_refused(stamp):
    with pytest.raises(DamagedError):
        scip.sweep(response(stamp, b"0000"), 3, 1)


def test_a_response_without_a_body_is_refused():
    with pytest.raises(DamagedError):
        scip.sweep(scip.Response("MD", "99", ()), 3, 1)


def test_no_single_wrong_byte_gets_past_the_checks(rng):
    """The 64 characters differ in the low 6 bits of their sum; others are refused as invalid."""
    clean = scip_noise.CLEAN
    assert scip_noise.accepted(clean) is not None
    for place in range(len(clean)):
        data = bytearray(clean)
        data[place] ^= int(rng.integers(1, 256))
        taken = scip_noise.accepted(bytes(data))
        assert taken is None or np.array_equal(taken.values, scip_noise.VALUES)


@pytest.mark.parametrize(
    ("damage", "errors", "most"),
    [
        # Two in range (1/4 each) in one of 33 lines, their sums alike (1/64): 3e-5.
        (scip_noise.uniform, 2, 1e-3),
        (scip_noise.lost, 5, 1e-3),
        (scip_noise.burst, 16, 1e-3),
    ],
)
def test_several_wrong_bytes_rarely_get_past_the_checks(damage, errors, most, rng):
    assert scip_noise.share(damage, errors, 2000, rng) <= most


@given(st.binary(max_size=300), st.integers(0, 2000))
def test_any_bytes_are_taken_without_raising(junk, place):
    clean = scip_noise.CLEAN
    scip_noise.accepted(junk)
    scip_noise.accepted(clean[:place] + junk + clean[place:])


def test_error_codes_and_values_outside_the_limits_are_not_ranges():
    values = np.array([0, 1, 19, 20, 21, 5600, 5601, 262143])
    expected = [0, 0, 0, 0.020, 0.021, 5.6, 0, 0]
    np.testing.assert_allclose(scip.to_metres(values, 20, 5600), expected, atol=1e-12)
    # A sensor that measures from 5 mm on has the same codes.
    np.testing.assert_allclose(scip.to_metres(values, 5, 5600), expected, atol=1e-12)


# --------------------------------------------------------------------------- what it says of itself


def test_the_protocols_examples_of_version_and_parameters():
    known = MeasurementParameters.of(PP)
    assert known == MeasurementParameters(
        "URG-04LX(Hokuyo Automatic Co.,Ltd.)", 20, 5600, 1024, 44, 725, 384, 600
    )
    assert known.turn == pytest.approx(0.1)
    assert known.step_time == pytest.approx(97.65625e-6)
    assert known.step_angle == pytest.approx(np.radians(0.3515625))
    assert Version.of(VV).serial == "H0614967"
    assert Version.of(VV).product == "SOKUIKI Sensor URG-04LX"
    assert fields(II)["STAT"] == "Sensor works well."


def test_written_lines_are_read_back():
    assert b"".join(to_line(k, v) for k, v in fields(PP).items()) == b"\n".join((*PP, b""))


@pytest.mark.parametrize(
    "line", [b"", b"DMIN:20", b"DMIN:20;", b"DMIN:20;5", b"DMIN20;4", b"D:\xff;0"]
)
def test_damaged_lines_are_refused(line):
    with pytest.raises(DamagedError):
        fields((line,))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("DMIN", "5600"),
        ("DMIN", "-1"),
        ("DMAX", "999999999999999999999"),
        ("DMAX", "nan"),
        ("ARES", "0"),
        ("ARES", "681"),  # more than a turn
        ("AMIN", "725"),
        ("AMAX", "44"),
        ("AMAX", "10000"),
        ("AFRT", "1e3"),
        ("SCAN", "0"),
        ("SCAN", ""),
        ("SCAN", "²"),
    ],
)
def test_impossible_parameters_are_refused(key, value):
    changed = fields(PP) | {key: value}
    lines = tuple(to_line(k, v)[:-1] for k, v in changed.items() if v.isascii())
    with pytest.raises(DeviceError, match="is it a SCIP"):
        MeasurementParameters.of(lines)


# --------------------------------------------------------------------------- statuses

EVERY = [
    *((command, "00") for command in ("VV", "PP", "II", "TM", "BM", "MD", "GD", "QT", "RS", "SS")),
    *((command, f"0{n}") for command in ("MD", "MS") for n in range(1, 8)),
    *((command, f"0{n}") for command in ("GD", "GS") for n in range(1, 6)),
    *((command, "10") for command in ("GD", "GS")),
    *(("MD", f"{n}") for n in (*range(21, 100),)),
    *(("GD", f"{n}") for n in range(50, 98)),
    *(("BM", f"0{n}") for n in (1, 2)),
    *((command, f"0{n}") for command in ("TM", "SS", "CR") for n in range(1, 5)),
    *(("HS", f"0{n}") for n in range(1, 4)),
    *(("DB", f"0{n}") for n in range(1, 6)),
    *((command, f"0{letter}") for command in ("VV", "MD", "??") for letter in "ABCDEFGHI"),
    ("SCIP2.0", "0"),
]


@pytest.mark.parametrize(("command", "status"), EVERY)
def test_every_status_has_a_description(command, status):
    assert "does not explain" not in scip_status.words(command, status)


@pytest.mark.parametrize(
    ("command", "status"), [("QT", "01"), ("MD", "08"), ("VV", "xx"), ("", "")]
)
def test_an_unknown_status_is_described_as_such(command, status):
    assert "does not explain" in scip_status.words(command, status)


def test_statuses_are_classified():
    assert [n for n in range(100) if scip_status.is_verifying(f"{n:02d}")] == [*range(21, 50)]
    assert [n for n in range(100) if scip_status.is_malfunction("MD", f"{n:02d}")] == [
        *range(50, 98)
    ]
    assert scip_status.is_malfunction("BM", "01")
    assert not scip_status.is_malfunction("BM", "02")
    assert not scip_status.is_malfunction("MD", "0A")
