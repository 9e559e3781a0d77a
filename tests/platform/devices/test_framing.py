"""Frames are decoded exactly or not at all, and losses are counted."""

import binascii
import time
import tracemalloc
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from impslam.platform.devices.framing import MAX_PAYLOAD, VERSION, Decoder, Encoder

ANY = range(256)
PAYLOADS = st.lists(st.binary(max_size=MAX_PAYLOAD), max_size=20)


def decoder(known=ANY):
    counts = Counter()
    return Decoder(known, lambda what, n: counts.update({what: n})), counts


def frames_of(payloads, boot=1, kind=2):
    encoder = Encoder(boot)
    return [encoder.encode(kind, payload)[1] for payload in payloads]


def pieces(data, cuts):
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in pairwise(edges)]


# ------------------------------------------------------------------------ what is sent comes back


@given(PAYLOADS, st.lists(st.integers(0, 10_000), max_size=50))
def test_frames_are_decoded_from_any_pieces(payloads, cuts):
    taker, counts = decoder()
    got = [
        frame
        for piece in pieces(b"".join(frames_of(payloads)), cuts)
        for frame in taker.feed(piece)
    ]
    assert [frame.payload for frame in got] == payloads
    assert [frame.sequence for frame in got] == list(range(len(payloads)))
    assert {(frame.type, frame.boot) for frame in got} <= {(2, 1)}
    assert counts == ({"frames": len(payloads)} if payloads else {})


@given(st.binary(max_size=MAX_PAYLOAD), st.integers(0, 255), st.integers(0, 255))
def test_the_layout_on_the_wire(payload, kind, boot):
    _, wire = Encoder(boot).encode(kind, payload)
    assert wire[-1] == 0
    assert 0 not in wire[:-1]
    assert len(wire) == len(payload) + 9
    body = cobs.decode(wire[:-1])
    assert body[:5] == bytes([VERSION, kind, boot, 0, 0])
    assert body[5:-2] == payload
    assert int.from_bytes(body[-2:], "little") == binascii.crc_hqx(body[:-2], 0)


def test_the_crc_is_xmodems():
    assert binascii.crc_hqx(b"123456789", 0) == 0x31C3  # the check value of its catalogue entry


def test_a_payload_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="247 fit"):
        Encoder().encode(1, bytes(MAX_PAYLOAD + 1))


def test_sequence_numbers_wrap():
    encoder, (taker, counts) = Encoder(), decoder()
    got = [taker.feed(encoder.encode(1)[1])[0].sequence for _ in range(65_540)]
    assert got[65_534:] == [65_534, 65_535, 0, 1, 2, 3]
    assert counts == {"frames": 65_540}


def test_zeros_between_frames_are_ignored():
    taker, counts = decoder()
    for wire in frames_of([b"a", b"b"]):
        taker.feed(b"\0\0" + wire + b"\0")
    assert counts == {"frames": 2}


# ------------------------------------------------------------------------ lost, repeated, late


@given(st.sets(st.integers(1, 198)))
def test_lost_frames_are_counted(missing):
    taker, counts = decoder()
    for number, wire in enumerate(frames_of([b"x"] * 200)):
        if number not in missing:
            taker.feed(wire)
    assert counts["lost"] == len(missing)
    assert counts["frames"] == 200 - len(missing)


def test_losses_across_the_wrap_of_numbers_are_counted():
    taker, counts = decoder()
    for number, wire in enumerate(frames_of([b""] * 65_600)):
        if not 65_500 <= number < 65_560:
            taker.feed(wire)
    assert counts == {"frames": 65_540, "lost": 60}


def test_repeated_and_late_frames_are_dropped_and_counted():
    one, two, three, four = frames_of([b"1", b"2", b"3", b"4"])
    taker, counts = decoder()
    got = taker.feed(one + three + three + two + two + four)
    assert [frame.payload for frame in got] == [b"1", b"3", b"4"]
    assert counts == {"frames": 3, "lost": 1, "repeated": 1, "late": 2}


def test_a_restart_of_the_sender_is_not_a_loss():
    taker, counts = decoder()
    for wire in frames_of([b""] * 500, boot=1)[400:]:
        taker.feed(wire)
    for wire in frames_of([b""] * 20, boot=2)[1:]:  # its first frame was lost
        taker.feed(wire)
    assert counts == {"frames": 119, "restarted": 1}


def test_a_restart_under_the_same_boot_number_is_accepted_after_three_frames():
    taker, counts = decoder()
    for wire in frames_of([b""] * 500):
        taker.feed(wire)
    got = [frame.sequence for wire in frames_of([b""] * 20) for frame in taker.feed(wire)]
    assert got == list(range(2, 20))
    assert counts == {"frames": 518, "late": 2, "restarted": 1}


def test_inconsecutive_late_frames_are_not_a_restart():
    taker, counts = decoder()
    wires = frames_of([b""] * 500)
    for wire in wires:
        taker.feed(wire)
    for number in (10, 20, 30, 40, 5, 6, 9):
        assert not taker.feed(wires[number])
    assert counts == {"frames": 500, "late": 7}


def test_other_versions_and_types_are_counted_separately():
    taker, counts = decoder(known={1})
    encoder = Encoder()
    got = taker.feed(encoder.encode(1)[1] + encoder.encode(9)[1] + encoder.encode(1)[1])
    assert [frame.sequence for frame in got] == [0, 2]
    body = bytes([VERSION + 1, 1, 0, 3, 0])
    body += binascii.crc_hqx(body, 0).to_bytes(2, "little")
    assert taker.feed(cobs.encode(body) + b"\0") == []
    assert counts == {"frames": 2, "unknown type": 1, "unknown version": 1}


def test_a_new_connection_begins_in_the_middle_of_a_frame_and_goes_on_counting():
    wires = frames_of([b"abc"] * 10)
    taker, counts = decoder()
    for wire in wires[:3]:
        taker.feed(wire)
    taker.feed(wires[3][:4])
    taker.restart()
    for piece in (wires[5][5:], wires[6]):
        taker.feed(piece)
    assert counts == {"frames": 4, "fragment": 1, "lost": 3}
    taker.restart(keep_sequence=False)
    taker.feed(wires[9])
    assert counts == {"frames": 5, "fragment": 1, "lost": 3}


# ------------------------------------------------------------------------ garbage


@given(st.lists(st.binary(max_size=600), max_size=20))
def test_random_bytes_never_raise_nor_give_a_frame_that_was_not_sent(chunks):
    taker, counts = decoder()
    for chunk in chunks:
        for frame in taker.feed(chunk):
            encoder = Encoder(frame.boot)
            encoder._next = frame.sequence
            assert encoder.encode(frame.type, frame.payload)[1][:-1] in b"".join(chunks)
    assert set(counts) <= {"frames", "fragment", "corrupt", "unknown version", "late", "lost"}


def test_garbage_without_a_zero_takes_no_memory():
    taker, counts = decoder()
    taker.feed(b"\0")
    chunk = b"\xa5" * 65_536
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(200):
        taker.feed(chunk)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 4096
    (frame,) = taker.feed(b"\0" + frames_of([b"after"])[0])
    assert frame.payload == b"after"
    assert counts == {"corrupt": 1, "frames": 1}


@pytest.mark.parametrize("length", range(7, 254))
def test_zeros_are_not_a_frame_although_their_crc_is_zero(length):
    """Real frames contain readings of 0 in a row, and noise cuts pieces out of them."""
    taker, counts = decoder()
    assert not taker.feed(cobs.encode(bytes(length)) + b"\0")
    assert counts == {"unknown version": 1}


def test_millions_of_bytes_of_noise_are_read_fast_and_hold_no_more_frames_than_chance():
    taker, counts = decoder()
    noise = np.random.default_rng(1).integers(0, 256, 8_000_000, np.uint8).tobytes()
    begin = time.process_time()
    for start in range(0, len(noise), 4096):
        taker.feed(noise[start : start + 4096])
    spent = time.process_time() - begin
    # Of 31 000 pieces one in 65 536 has a CRC that fits, and of those one in 256 a version.
    assert counts["frames"] + counts["unknown type"] == 0
    assert counts["unknown version"] <= stats.poisson.ppf(1 - 1e-6, counts["corrupt"] / 65_536)
    assert counts["corrupt"] > 25_000
    assert len(noise) / spent > 2e6  # forty times what the line carries


def test_any_burst_error_up_to_16_bits_before_cobs_is_detected():
    """A CRC of 16 bits detects every such burst in the bytes that it covers."""
    body = cobs.decode(frames_of([bytes(range(40))])[0][:-1])
    taker, counts = decoder()
    rng = np.random.default_rng(2)
    number = 0
    for _ in range(40_000):
        length = int(rng.integers(1, 17))
        burst = int(rng.integers(0, 1 << length)) | 1 | 1 << (length - 1)
        shift = int(rng.integers(0, 8 * len(body) - length + 1))
        spoilt = int.from_bytes(body, "big") ^ burst << shift
        assert not taker.feed(cobs.encode(spoilt.to_bytes(len(body), "big")) + b"\0")
        number += 1
    assert counts == {"corrupt": number - 1, "fragment": 1}


@pytest.mark.parametrize("flips", [2, 5, 12, 270])
def test_corrupt_frames_pass_no_more_often_than_expected_of_the_crc(flips):
    """Wrong bits anywhere on the wire, 50 000 times each; 270 of 544 is pure noise."""
    rng = np.random.default_rng(20261121 + flips)
    wire = frames_of([rng.integers(0, 256, 60, np.uint8).tobytes()])[0][:-1]
    bits = np.unpackbits(np.frombuffer(wire, np.uint8))
    taker, counts = decoder()
    taker.feed(b"\0")
    for _ in range(50):
        wrong = np.zeros((1000, len(bits)), bool)
        wrong[np.arange(1000)[:, None], rng.integers(0, len(bits), (1000, flips))] = True
        rows = np.packbits(bits ^ wrong, axis=1)
        taker.feed(np.hstack([rows, np.zeros((1000, 1), np.uint8)]).tobytes())
    pieces_seen = counts["corrupt"]
    passed = sum(counts[what] for what in ("frames", "repeated", "late", "unknown type"))
    assert pieces_seen >= 49_900
    assert passed <= stats.binom.ppf(1 - 1e-4, pieces_seen, 2.0**-16)


@given(PAYLOADS.filter(bool), st.data())
def test_after_a_cut_or_a_flip_the_next_frames_come_through(payloads, data):
    wires = frames_of(payloads)
    spoilt = data.draw(st.integers(0, len(wires) - 1))
    wire = bytearray(wires[spoilt])
    place = data.draw(st.integers(0, len(wire) - 1))
    if data.draw(st.booleans()):
        del wire[place:]
        wire += b"\0"
    else:
        wire[place] ^= data.draw(st.integers(1, 255))
    wires[spoilt] = bytes(wire)
    taker, _ = decoder()
    got = [frame.payload for frame in taker.feed(b"".join(wires))]
    # A flipped zero joins the frame to the next one: both are lost, and no more.
    kept = len(payloads) - 2
    assert len(got) >= kept
    assert all(payload in payloads for payload in got)
    assert got[-1:] == payloads[-1:] or spoilt >= kept
