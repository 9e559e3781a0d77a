"""docs/autopilot-protocol.md matches the code: tables, examples, budget, C code."""

import ctypes
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from impslam.platform.devices.autopilot_messages import (
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
from impslam.platform.devices.framing import MAX_PAYLOAD, Decoder, Encoder
from impslam.platform.virtual.wheel_encoders import Accumulator

PAGE = (Path(__file__).parents[3] / "docs" / "autopilot-protocol.md").read_text("utf-8")
CODES = {"u8": "B", "u16": "H", "u32": "I", "u64": "Q", "i16": "h", "i32": "i", "i64": "q"}
CODES |= {"f32": "f", "i16 x 3": "hhh"}
MESSAGES = {
    FrameType.HELLO: Hello,
    FrameType.SENSORS: Sensors,
    FrameType.ACK: Ack,
    FrameType.DRIVE: DriveCommand,
    FrameType.SET_TIME: SetTime,
}
EXAMPLE = Sensors(
    clock=12_345_678,
    counts=(-5, 40_960),
    voltages=(4091, 0),
    gyro=(10, -20, 30),
    accelerometer=(0, 0, 8192),
    accelerometer_2=(1, -1, 4096),
    magnetometer=(133, -7, -300),
    temperature=2315,
    humidity=4480,
    flags=Flag(0),
    applied=258,
    applied_clock=12_300_000,
)


def rows(section):
    """Return the cells of the first table after a heading with this beginning."""
    text = PAGE[PAGE.index(f"\n{section}") + 1 :]
    table = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE).group()
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


def expanded(layout):
    return re.sub(r"(\d+)(\w)", lambda match: int(match[1]) * match[2], layout.format[1:])


@pytest.mark.parametrize("kind", MESSAGES)
def test_the_tables_are_the_layouts(kind):
    table = rows(f"### {kind.name}, 0x{kind.value:02x}, ")
    layout = MESSAGES[kind].LAYOUT
    assert "".join(CODES[row[1]] for row in table) == expanded(layout)
    offset, sizes = 0, {"u8": 1, "i16 x 3": 6}
    for at, kind_of, *_ in table:
        assert int(at) == offset
        offset += sizes.get(kind_of) or int(kind_of[1:]) // 8
    assert offset == layout.size


def test_the_codes_match_the_code():
    assert f"STOP, 0x{FrameType.STOP:02x}, and RELEASE, 0x{FrameType.RELEASE:02x}" in PAGE
    reasons = ", ".join(f"{r.value} {r.name.lower().replace('_', '-')}" for r in Reset)
    assert reasons.replace("4 pin", "4 reset pin") in PAGE
    flags = next(row for row in rows("### SENSORS") if row[2] == "flags")[3]
    assert [int(bit) for bit in re.findall(r"(\d):", flags)] == list(range(len(Flag)))
    results = next(row for row in rows("### ACK") if row[2] == "result")[3]
    assert [int(n) for n in re.findall(r"(\d) ", results)] == [r.value for r in Result]
    assert f"0 to {MAX_PAYLOAD} bytes" in PAGE


def test_the_budget_adds_up():
    total = 0.0
    for _, frame, size, rate, bits in rows("## The line"):
        kind = FrameType[frame]
        assert int(size) == MESSAGES[kind].LAYOUT.size + 9
        assert float(bits) == pytest.approx(10 * int(size) * float(rate), rel=1e-3)
        total += float(bits) if kind in {FrameType.SENSORS, FrameType.HELLO, FrameType.ACK} else 0.0
    assert f"{total / 1e3:.0f} kbit/s, {total / 460800:.0%}".replace("%", " %") in PAGE


def test_the_examples_match_encoded_frames():
    examples = [bytes.fromhex(text) for text in re.findall(r"```hex\n(.*?)```", PAGE, re.DOTALL)]
    host = Encoder(1)
    drive, stop = (
        host.encode(FrameType.DRIVE, DriveCommand(300, -200).pack()),
        host.encode(FrameType.STOP),
    )
    sensors = Encoder(7).encode(FrameType.SENSORS, EXAMPLE.pack())
    assert examples == [drive[1], stop[1], sensors[1]]


# ------------------------------------------------------------------------ the C code


@pytest.fixture(scope="module")
def firmware(tmp_path_factory):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler (cc)")
    folder = tmp_path_factory.mktemp("firmware")
    (folder / "firmware.c").write_text(re.search(r"```c\n(.*?)```", PAGE, re.DOTALL)[1], "utf-8")
    command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run(
        [*command, "-o", str(folder / "firmware.so"), str(folder / "firmware.c")], check=True
    )
    library = ctypes.CDLL(str(folder / "firmware.so"))
    library.frame.restype = library.take.restype = ctypes.c_size_t
    library.crc16.restype = ctypes.c_uint16
    library.frame.argtypes = [ctypes.c_uint8, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p]
    return library


def test_c_and_python_read_each_other(firmware):
    rng = np.random.default_rng(1)
    counts = Counter()
    decoder = Decoder(range(256), lambda what, n: counts.update({what: n}))
    encoder, body = Encoder(3), ctypes.create_string_buffer(256)
    for number in range(2000):
        payload = rng.integers(0, 256, rng.integers(0, MAX_PAYLOAD + 1), np.uint8)
        payload = (payload * (rng.random(len(payload)) < 0.7)).astype(np.uint8).tobytes()
        wire = ctypes.create_string_buffer(300)
        length = firmware.frame(number % 256, payload, len(payload), wire)
        (frame,) = decoder.feed(wire.raw[:length])
        assert (frame.type, frame.sequence, frame.payload) == (number % 256, number, payload)
        ends = [firmware.take(byte, body) for byte in encoder.encode(number % 256, payload)[1]]
        assert ends == [0] * (len(ends) - 1) + [len(payload) + 5]
        assert body.raw[5 : 5 + len(payload)] == payload
        assert body.raw[1] == number % 256
    assert counts == {"frames": 2000}


def test_c_decodes_the_frame_after_noise(firmware):
    rng = np.random.default_rng(2)
    body = ctypes.create_string_buffer(256)
    noise = rng.integers(0, 256, 300_000, np.uint8).tolist() + [7] * 1000
    assert sum(firmware.take(byte, body) > 0 for byte in noise) <= 1
    wire = b"\0" + Encoder(3).encode(FrameType.DRIVE, DriveCommand(1, 2).pack())[1]
    assert [firmware.take(byte, body) for byte in wire][-1] == 9
    assert DriveCommand.parse(body.raw[5:9]) == DriveCommand(1, 2)


def test_c_counts_as_the_emulator_does(firmware):
    class Encoders(ctypes.Structure):
        _fields_ = (
            ("count", ctypes.c_int32),
            ("reading", ctypes.c_int16),
            ("started", ctypes.c_uint8),
            ("jumps", ctypes.c_uint8),
        )

    rng = np.random.default_rng(3)
    readings = np.cumsum(rng.integers(-12, 22, 20_000)) % 4096
    jumps = rng.random(len(readings)) < 0.01
    readings[jumps] = rng.integers(0, 4096, jumps.sum())
    encoder, accumulator = Encoders(), Accumulator()
    for number, reading in enumerate(readings.tolist()):
        firmware.encoder_add(ctypes.byref(encoder), ctypes.c_int16(reading))
        accumulator.add(reading, 0.0)  # no time passes: the limit stays that of 1 ms
        assert (encoder.count, encoder.reading) == (accumulator.count, accumulator.reading), number
    assert encoder.count > 4096
