import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.platform.devices.rplidar_parser import HELD_BACK, MIN_CHAIN, Parser
from impslam.platform.devices.rplidar_protocol import (
    CAPSULE,
    DESCRIPTORS,
    NODE,
    SAMPLES,
    Answer,
    Command,
    Condition,
    Info,
    Nodes,
    request,
)

BEAMS = 400


def node(number, start=None):
    """Return a node of a turn of 400, whose distance encodes its number."""
    place = number % BEAMS
    first = place == 0 if start is None else start
    angle = round(place * 360 * 64 / BEAMS) << 1 | 1
    distance = number % 0xFFFF + 1
    return (
        bytes(((1 if first else 2) | 15 << 2,))
        + angle.to_bytes(2, "little")
        + distance.to_bytes(2, "little")
    )


def capsule(number, degrees=28.8, fresh=False, shift=0):
    """Return a capsule, 28.8 deg wide; distances in mm encode the measurement's number."""
    angle = round((number * degrees) % 360.0 * 64)
    body = (angle | (0x8000 if fresh else 0)).to_bytes(2, "little")
    for cabin in range(SAMPLES // 2):
        for half in range(2):
            distance = (number * SAMPLES + 2 * cabin + half) % 0x3FFF + 1
            body += (distance << 2 | shift >> 4).to_bytes(2, "little")
        body += bytes((shift & 0xF | (shift & 0xF) << 4,))
    check = 0
    for byte in body:
        check ^= byte
    return bytes((0xA0 | check & 0xF, 0x50 | check >> 4)) + body


NODES = b"".join(node(k) for k in range(1000))
CAPSULES = b"".join(capsule(k, fresh=k == 0) for k in range(60))
STREAMS = {Command.SCAN: NODES, Command.EXPRESS: CAPSULES}


def started(command, counts=None):
    parser = Parser()
    assert parser.feed(DESCRIPTORS[command]) == []
    return parser


def joined(parts, field):
    return np.concatenate([getattr(p, field) for p in parts if isinstance(p, Nodes)] or [[]])


def told_numbers(command, parts):
    """Return the numbers encoded in accepted distances."""
    unit = 4000 if command == Command.SCAN else 1000
    return np.round(joined(parts, "ranges") * unit).astype(int) - 1


@pytest.mark.parametrize(
    ("made", "printed"),
    [
        (request(Command.STOP), "A525"),
        (request(Command.SCAN), "A520"),
        (request(Command.EXPRESS, bytes(5)), "A582050000000000 22"),
        (request(Command.PWM, (660).to_bytes(2, "little")), "A5F0029402C1"),
        (DESCRIPTORS[Command.SCAN], "A55A0500004081"),
        (DESCRIPTORS[Command.EXPRESS], "A55A5400004082"),
        (DESCRIPTORS[Command.INFO], "A55A1400000004"),
        (DESCRIPTORS[Command.HEALTH], "A55A0300000006"),
    ],
)
def test_requests_match_the_manufacturers_notes(made, printed):
    assert made == bytes.fromhex(printed)


def test_answers_are_found_among_other_bytes_however_cut():
    serial = bytes(range(16))
    data = b"RP LIDAR System.\r\n\xa5\xa5\x5a\x01" + DESCRIPTORS[Command.INFO]
    data += bytes((0x18, 29, 1, 7)) + serial + DESCRIPTORS[Command.HEALTH] + b"\x02\x34\x12"
    for size in (1, 2, 3, 7, 1000):
        parser = Parser()
        found = [a for i in range(0, len(data), size) for a in parser.feed(data[i : i + size])]
        assert [a.command for a in found] == [Command.INFO, Command.HEALTH]
        info, condition = Info.parse(found[0].data), Condition.parse(found[1].data)
        assert info == Info(0x18, (1, 29), 7, serial.hex().upper())
        assert condition == Condition(2, 0x1234)


def test_a_printed_node():
    # S = 1, quality 15, angle 90.5 deg, distance 1 m; then some that follow.
    angles = [90.5, 91.5, 92.5, 93.5, 94.5, 95.5]
    data = b"".join(
        bytes(((1 if k == 0 else 2) | 15 << 2,))
        + (int(a * 64) << 1 | 1).to_bytes(2, "little")
        + (4000).to_bytes(2, "little")
        for k, a in enumerate(angles)
    )
    (nodes,) = started(Command.SCAN).feed(data)
    np.testing.assert_allclose(np.degrees(nodes.angles), angles[:-HELD_BACK])
    np.testing.assert_array_equal(nodes.ranges, 1.0)
    np.testing.assert_array_equal(nodes.qualities, 15.0)
    np.testing.assert_array_equal(nodes.starts, [True, False, False, False])


@pytest.mark.parametrize("command", STREAMS)
@pytest.mark.parametrize("size", [1, 2, 5, 83, 100000])
def test_a_clean_stream_is_read_whole_however_cut(command, size):
    parser, data = started(command), STREAMS[command]
    parts = [p for i in range(0, len(data), size) for p in parser.feed(data[i : i + size])]
    numbers = told_numbers(command, parts)
    whole = 1000 - HELD_BACK if command == Command.SCAN else 59 * SAMPLES  # the last one waits
    np.testing.assert_array_equal(numbers, np.arange(whole))
    assert [p.first for p in parts] == np.cumsum([0, *(len(p.ranges) for p in parts)])[:-1].tolist()
    assert not parser.counts
    angles = np.degrees(joined(parts, "angles"))
    even = np.arange(whole) % BEAMS * 360 / BEAMS
    # Angles come in 1/64 deg.
    assert abs((angles - even + 180) % 360 - 180).max() < 1 / 64
    starts = np.flatnonzero(joined(parts, "starts"))
    assert np.all(np.abs((starts + BEAMS / 2) % BEAMS - BEAMS / 2) <= 1)
    assert len(starts) == whole // BEAMS + 1


def test_a_capsules_shift_is_taken_off_its_angle():
    shift = 0b101101  # 45/8 deg
    parser = started(Command.EXPRESS)
    (nodes,) = parser.feed(capsule(1, shift=shift) + capsule(2))
    expected = 28.8 + 28.8 / 32 * np.arange(32) - 45 / 8
    np.testing.assert_allclose(np.degrees(nodes.angles), expected, atol=1 / 64)
    np.testing.assert_allclose(nodes.ranges, (np.arange(32) + 33) / 1000)


def test_every_flipped_bit_of_a_capsule_is_detected():
    sound, following = capsule(1), capsule(2)
    for bit in range(8 * CAPSULE):
        broken = bytearray(sound)
        broken[bit // 8] ^= 1 << bit % 8
        parser = started(Command.EXPRESS)
        assert parser.feed(bytes(broken) + following) == []
        assert parser.counts["corrupt"] == SAMPLES


def test_flipped_bits_of_nodes_are_detected_if_the_format_allows():
    seen = 0
    for bit in range(8 * NODE):
        data = bytearray(NODES[: 100 * NODE])
        data[50 * NODE + bit // 8] ^= 1 << bit % 8
        parser = started(Command.SCAN)
        number = len(joined(parser.feed(bytes(data)), "ranges"))
        costs = 100 - HELD_BACK - number
        assert costs in {0, 1 + HELD_BACK}
        assert parser.counts["corrupt"] == costs
        seen += costs > 0
    # S, not S, the check bit, and the angle's upper bits (16 deg and more): 8 of 40.
    assert seen == 8


@pytest.mark.parametrize("command", STREAMS)
@pytest.mark.parametrize("lost", [1, 2, 3, 4, 7, 83])
def test_lost_bytes_only_affect_their_measurements(command, lost):
    data = STREAMS[command]
    size, most = (
        (NODE, lost // NODE + 2 + HELD_BACK) if command == Command.SCAN else (CAPSULE, 3 * SAMPLES)
    )
    at = size * 10 + 3
    parser = started(command)
    numbers = told_numbers(command, parser.feed(data[:at] + data[at + lost :]))
    total = len(data) // size * (1 if size == NODE else SAMPLES)
    waits = HELD_BACK if size == NODE else SAMPLES
    assert total - waits - len(numbers) <= most
    np.testing.assert_array_equal(np.setdiff1d(numbers, np.arange(total)), [])
    assert parser.counts["corrupt"] > 0 or parser.counts["gaps"] > 0


def test_a_lost_capsule_does_not_stretch_the_one_before():
    data = b"".join(capsule(k) for k in range(20) if k != 10)
    parser = started(Command.EXPRESS)
    parts = parser.feed(data)
    numbers = told_numbers(Command.EXPRESS, parts)
    angles = np.degrees(joined(parts, "angles"))
    assert abs((angles - numbers * 0.9 + 180) % 360 - 180).max() < 1 / 32
    assert parser.counts["gaps"] >= 1


@pytest.mark.parametrize("command", STREAMS)
def test_noise_on_the_line(command, rng):
    """Bits flip at 1e-3: accepted values are right as far as the format can detect errors."""
    data = np.frombuffer(STREAMS[command] * 20, np.uint8).copy()
    if command == Command.EXPRESS:
        data = np.frombuffer(b"".join(capsule(k) for k in range(1200)), np.uint8).copy()
    flips = rng.random((len(data), 8)) < 1e-3
    data ^= np.packbits(flips, axis=1).ravel()
    parser = started(command)
    parts = parser.feed(data.tobytes())
    numbers = told_numbers(command, parts)
    if command == Command.EXPRESS:
        # 672 bits: half the capsules are hit, and each costs its forerunner too.
        kept = (1 - 1e-3) ** (2 * 8 * CAPSULE)
        assert len(numbers) / (1200 * SAMPLES) == pytest.approx(kept, abs=0.06)
        steps = np.diff(numbers.reshape(-1, SAMPLES), axis=1)
        wrong = np.mean((steps != 1).any(1) & (numbers.reshape(-1, SAMPLES)[:, 0] < 0x3FE0))
        # Two flips in one column of the XOR: (672^2 / 16) 1e-6 exp(-0.67) = 1.4 % of them.
        assert wrong < 0.05
    else:
        assert len(numbers) / (len(data) / NODE) > 0.92
    assert parser.counts["corrupt"] > 0


@pytest.mark.parametrize("command", STREAMS)
def test_random_bytes_are_refused_within_theory(command, rng):
    data = rng.integers(0, 256, 200_000, dtype=np.uint8).tobytes()
    parser = started(command)
    parts = parser.feed(data)
    accepted = len(joined(parts, "ranges"))
    if command == Command.SCAN:
        # At each byte a chain of four begins with 0.18^4 (2 * 15/360)^3 = 6e-7.
        assert accepted <= 2 * MIN_CHAIN
        assert parser.counts["corrupt"] == pytest.approx(len(data) / NODE, rel=0.01)
    else:
        assert accepted == 0  # two capsules in a row: 200000 / 65536^2


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from([None, Command.SCAN, Command.EXPRESS]),
    st.lists(
        st.one_of(
            st.binary(max_size=200),
            st.sampled_from(
                [NODES[:300], CAPSULES[:400], *DESCRIPTORS.values(), CAPSULES[100:350]]
            ),
        ),
        max_size=12,
    ),
    st.integers(1, 97),
)
def test_any_bytes_are_parsed_to_possible_values_without_errors(command, pieces, size):
    parser = started(command) if command else Parser()
    data = b"".join(pieces)
    for i in range(0, len(data), size):
        for part in parser.feed(data[i : i + size]):
            if isinstance(part, Answer):
                continue
            assert len(part.starts) == len(part.angles) == len(part.ranges) > 0
            assert np.all((part.angles >= 0) & (part.angles < 2 * math.pi))
            assert np.all((part.ranges >= 0) & (part.ranges < 17))
            assert part.first >= 0
    assert all(number >= 0 for number in parser.counts.values())
    assert len(parser._buffer) < 2 * CAPSULE  # nothing is kept for ever


def test_results_do_not_depend_on_the_pieces(rng):
    data = NODES[:300] + b"\x00\x13" + NODES[302:900] + NODES[903:2000]
    whole = told_numbers(Command.SCAN, started(Command.SCAN).feed(data))
    for _ in range(20):
        cuts = np.sort(rng.integers(0, len(data), 30))
        parser = started(Command.SCAN)
        parts = [
            p
            for piece in np.split(np.frombuffer(data, np.uint8), cuts)
            for p in parser.feed(piece.tobytes())
        ]
        np.testing.assert_array_equal(told_numbers(Command.SCAN, parts), whole)
