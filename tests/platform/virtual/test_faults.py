"""Faults on the bytes of a line, and their requests."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.errors import ConfigError
from impslam.platform.virtual.disturbance import KINDS, Disturbance
from impslam.platform.virtual.faults import LineNoise, Stall, parse_fault

DATA = bytes(range(256)) * 200


def disturbance(seed: int = 0) -> tuple[Disturbance, Counter[str]]:
    counts: Counter[str] = Counter()
    return Disturbance(np.random.default_rng(seed), counts), counts


@given(st.lists(st.binary(max_size=20)))
def test_without_a_fault_bytes_pass(chunks):
    line, counts = disturbance()
    assert b"".join(line.transfer(chunk, 0.1) for chunk in chunks) == b"".join(chunks)
    assert not counts


@given(st.lists(st.tuples(st.binary(max_size=20), st.floats(0.0, 2.0)), max_size=20))
def test_a_delay_keeps_all_bytes_in_order_and_ends(chunks):
    line, _ = disturbance()
    line.hold(1.0)
    chunks = sorted(chunks, key=lambda chunk: chunk[1])
    early = b"".join(line.transfer(data, time) for data, time in chunks if time < 1.0)
    late = b"".join(line.transfer(data, time) for data, time in chunks if time >= 1.0)
    assert early == b""
    assert late + line.transfer(b"", 2.0) == b"".join(data for data, _ in chunks)


def test_bytes_held_back_can_be_dropped():
    line, _ = disturbance()
    line.hold(1.0)
    line.transfer(b"abc", 0.5)
    line.clear()
    assert line.transfer(b"d", 1.5) == b"d"


def test_bytes_beyond_the_limit_of_a_held_line_are_counted():
    line, counts = disturbance()
    line.hold(1.0)
    for _ in range(3):
        line.transfer(bytes(500_000), 0.5)
    assert len(line.transfer(b"", 1.5)) + counts["overrun"] == 1_500_000
    assert counts["overrun"] > 0


@pytest.mark.parametrize("kind", KINDS)
def test_noise_has_its_rate_and_is_counted(kind):
    line, counts = disturbance(1)
    line.noise(0.01, kind, until=1.0)
    out = line.transfer(DATA, 0.5)
    number = 0.01 * len(DATA)
    assert counts[kind] == pytest.approx(number, abs=4 * np.sqrt(number))
    assert counts.total() == counts[kind]
    change = {"flip": 0, "drop": -1, "insert": 1}[kind]
    assert len(out) == len(DATA) + change * counts[kind]


def test_a_flip_changes_one_bit_of_a_byte():
    line, counts = disturbance(2)
    line.noise(0.01, "flip", until=1.0)
    out = np.frombuffer(line.transfer(DATA, 0.5), np.uint8)
    changed = out ^ np.frombuffer(DATA, np.uint8)
    assert np.count_nonzero(changed) == counts["flip"]
    assert set(np.bitwise_count(changed[changed > 0])) == {1}
    assert set(changed[changed > 0].tolist()) == {1 << bit for bit in range(8)}


def test_dropped_and_inserted_bytes_leave_the_others_in_order():
    line, counts = disturbance(3)
    line.noise(0.001, "drop", until=1.0)
    assert is_part_of(line.transfer(DATA, 0.5), DATA)
    line.noise(0.001, "insert", until=1.0)
    assert is_part_of(DATA, line.transfer(DATA, 0.5))
    assert counts["drop"] > 0
    assert counts["insert"] > 0


def is_part_of(part: bytes, whole: bytes) -> bool:
    rest = iter(whole)
    return all(byte in rest for byte in part)


def test_any_noise_is_of_all_kinds_and_ends():
    line, counts = disturbance(4)
    line.noise(0.05, "any", until=1.0)
    line.transfer(DATA, 0.5)
    assert all(counts[kind] > 500 for kind in KINDS)
    assert line.transfer(DATA, 1.0) == DATA


def test_the_same_seed_gives_the_same_noise():
    outs = []
    for seed in (5, 5, 6):
        line, _ = disturbance(seed)
        line.noise(0.01, "any", until=1.0)
        outs.append(line.transfer(DATA, 0.5))
    assert outs[0] == outs[1] != outs[2]


def test_faults_are_parsed_by_name():
    fault = parse_fault({"fault": "noise", "device": "lidar", "rate": 1e-4, "seconds": 1})
    assert fault == LineNoise(device="lidar", rate=1e-4, seconds=1.0, kind="any")
    assert parse_fault({"fault": "stall", "side": "both", "seconds": 2}) == Stall(
        side="both", seconds=2.0
    )


@pytest.mark.parametrize(
    "table",
    [
        {},
        {"fault": "fire"},
        {"fault": "noise", "device": "lidar", "rate": 2.0, "seconds": 1},
        {"fault": "noise", "device": "lidar", "rate": float("nan"), "seconds": 1},
        {"fault": "noise", "device": "camera", "rate": 0.1, "seconds": 1},
        {"fault": "unplug", "device": "lidar"},
        {"fault": "unplug", "device": "lidar", "seconds": -1},
        {"fault": "unplug", "device": "lidar", "seconds": float("inf")},
        {"fault": "reboot", "device": "lidar", "second": 1},
        {"fault": "stall", "side": "front", "seconds": 1},
    ],
)
def test_an_unknown_fault_is_a_one_line_error(table):
    with pytest.raises(ConfigError) as refusal:
        parse_fault(table)
    assert "\n" not in str(refusal.value)
