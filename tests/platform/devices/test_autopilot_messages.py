"""Packed payloads are parsed exactly; impossible values are refused in one line."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.errors import MessageError
from impslam.platform.devices.autopilot_messages import (
    Ack,
    DriveCommand,
    Flag,
    Hello,
    Reset,
    Result,
    Sensors,
    SetTime,
    parse_empty,
)

U16, I16 = st.integers(0, 65_535), st.integers(-32_768, 32_767)
I32, CLOCK = st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**15 - 1)
SCALE = st.floats(2.0**-40, 0.5, width=32)
TRIPLE = st.tuples(I16, I16, I16)

HELLOS = st.builds(
    Hello,
    st.integers(0, 2**32 - 1),
    st.integers(0, 255),
    st.integers(0, 255),
    st.sampled_from(Reset),
    SCALE,
    SCALE,
    SCALE,
    SCALE,
    CLOCK,
    st.integers(-(2**63), 2**63 - 1),
)
SENSORS = CLOCK.flatmap(
    lambda clock: st.builds(
        Sensors,
        clock=st.just(clock),
        counts=st.tuples(I32, I32),
        voltages=st.tuples(st.integers(0, 4095), st.integers(0, 4095)),
        gyro=TRIPLE,
        accelerometer=TRIPLE,
        accelerometer_2=TRIPLE,
        magnetometer=TRIPLE,
        temperature=st.integers(-4000, 12_500),
        humidity=st.integers(0, 10_000),
        flags=st.integers(0, 31).map(Flag),
        applied=U16,
        applied_clock=st.integers(0, clock),
    )
)
ACKS = st.builds(Ack, st.integers(0, 255), st.sampled_from(Result), U16, CLOCK)
SPEED = st.integers(-10_000, 10_000)
ALL = st.one_of(
    HELLOS,
    SENSORS,
    ACKS,
    st.builds(DriveCommand, SPEED, SPEED),
    st.builds(SetTime, st.integers(0, 10**16 - 1)),
)
STILL = Sensors(
    0, (0, 0), (0, 0), (0,) * 3, (0,) * 3, (0,) * 3, (0,) * 3, 2000, 5000, Flag(0), 0, 0
)
HELLO = Hello(1, 1, 0, Reset.POWER, 0.5, 0.25, 0.125, 0.0625, 0, 0)


@given(ALL)
def test_packed_payloads_are_parsed(message):
    assert type(message).parse(message.pack()) == message


def read(kind, payload):
    """Return the message, or the error."""
    try:
        return kind.parse(payload)
    except MessageError as error:
        return str(error)


@pytest.mark.parametrize("kind", [Hello, Sensors, Ack, DriveCommand, SetTime])
@given(data=st.data())
def test_any_bytes_are_parsed_or_refused_in_one_line(kind, data):
    size = kind.LAYOUT.size
    payload = data.draw(st.binary(max_size=100) | st.binary(min_size=size, max_size=size))
    read_or_why = read(kind, payload)
    if isinstance(read_or_why, str):
        assert "\n" not in read_or_why
    else:
        assert read_or_why.pack() == payload  # bits of a NaN, say, would not come back


@given(ALL, st.integers(-100, 100).filter(bool))
def test_wrong_lengths_are_refused(message, change):
    payload = message.pack()
    wrong = payload[:change] if change < 0 else payload + bytes(change)
    with pytest.raises(MessageError, match="bytes; it has"):
        type(message).parse(wrong)


@pytest.mark.parametrize("scale", [math.nan, math.inf, -1e-3, 0.0, 1.0])
@pytest.mark.parametrize("which", range(4))
def test_impossible_scales_are_refused(scale, which):
    payload = bytearray(HELLO.pack())
    struct.pack_into("<f", payload, 7 + 4 * which, scale)
    with pytest.raises(MessageError, match="a scale"):
        Hello.parse(bytes(payload))


@pytest.mark.parametrize(
    ("offset", "layout", "value", "what"),
    [
        (0, "<Q", 10**15, "a clock"),
        (16, "<H", 4096, "an encoder's reading"),
        (18, "<H", 4096, "an encoder's reading"),
        (44, "<h", -4001, "a temperature"),
        (44, "<h", 12_501, "a temperature"),
        (46, "<H", 10_001, "a humidity"),
        (48, "<H", 32, "a set of flags"),
        (52, "<Q", 1, "a command's moment"),  # later than the clock
    ],
)
def test_impossible_readings_are_refused(offset, layout, value, what):
    payload = bytearray(STILL.pack())
    struct.pack_into(layout, payload, offset, value)
    with pytest.raises(MessageError, match=what):
        Sensors.parse(bytes(payload))


@pytest.mark.parametrize(
    ("kind", "payload", "what"),
    [
        (Hello, HELLO.pack()[:6] + b"\x06" + HELLO.pack()[7:], "a reset reason"),
        (Ack, struct.pack("<BBHQ", 16, 4, 0, 0), "a result"),
        (Ack, struct.pack("<BBHQ", 16, 0, 0, 10**15), "a clock"),
        (DriveCommand, struct.pack("<hh", 10_001, 0), "a speed"),
        (DriveCommand, struct.pack("<hh", 0, -32_768), "a speed"),
        (SetTime, struct.pack("<Q", 10**16), "a time"),
    ],
)
def test_other_impossible_values_are_refused(kind, payload, what):
    with pytest.raises(MessageError, match=what):
        kind.parse(payload)


def test_commands_without_a_payload_have_none():
    parse_empty("STOP", b"")
    with pytest.raises(MessageError, match="STOP of 1 bytes; it has 0"):
        parse_empty("STOP", b"\0")
