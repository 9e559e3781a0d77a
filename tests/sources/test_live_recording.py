"""A log that is whole up to its last sync, whatever happened behind that."""

import errno
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader
from tests.sources.logs import read

from impslam.errors import ImpError, SourceError
from impslam.sources import live_recording
from impslam.sources.live_recording import LiveMcapWriter, is_being_written
from impslam.sources.mcap_reader import MAGIC
from impslam.types import Climate, Event, LaserScan, WheelAngles

SYNCS, EACH = 5, 8  # chunks of a log, and wheel readings in each
FUZZ = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def wheels(number: int) -> WheelAngles:
    return WheelAngles(100.0 + 0.125 * number, 0.1 * number, -0.1 * number)


def scan(number: int) -> LaserScan:
    ranges = np.random.default_rng(number).random(200)
    return LaserScan(100.0 + 0.125 * number, 0.01 * np.arange(200), ranges, np.zeros(200), 0.0, 8.0)


def fill(writer: LiveMcapWriter, ends: list[int]) -> None:
    """Write, and note where the file ends after each sync."""
    for sync in range(SYNCS):
        for i in range(EACH):
            number = EACH * sync + i
            writer.write(wheels(number), 100.0 + 0.125 * number)
        writer.write(scan(number), 100.0 + 0.125 * number)
        writer.sync()
        ends.append(writer.size)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[int]]:
    """What stands on the disk before the summary is written, and where each chunk ends."""
    path, ends = tmp_path_factory.mktemp("live") / "a.mcap", []
    with LiveMcapWriter(path, "imp", 99.0) as writer:
        fill(writer, ends)
        content = path.read_bytes()
    return content, ends


def numbers(path: Path) -> list[int]:
    """Return which wheel readings are in the log; every one must be right."""
    found, source = read(path)
    assert source.preset == "imp"
    those = [m for m in found if isinstance(m, WheelAngles)]
    kept = [round((m.stamp - 100.0) / 0.125) for m in those]
    assert [(m.left, m.right) for m in those] == [(0.1 * n, -0.1 * n) for n in kept]
    for message in found:
        if isinstance(message, LaserScan):
            want = scan(round((message.stamp - 100.0) / 0.125)).ranges.astype(np.float32)
            np.testing.assert_array_equal(message.ranges, want)
    assert source.problems.counts == {"cut file": 1}
    return kept


def assert_whole_chunks(path: Path, content: bytes, where: int, ends: list[int]) -> None:
    """What was synced before `where` is there, in order, and nothing is made up."""
    path.write_bytes(content)
    if where < ends[0]:  # not even the first sync was over when the file took its place
        try:
            read(path)
        except ImpError as error:
            assert "\n" not in str(error)  # noqa: PT017  # either is right
        return
    kept = numbers(path)
    synced = sum(end <= where for end in ends)
    assert kept[: EACH * synced] == list(range(EACH * synced))
    assert kept == list(range(len(kept)))


def test_a_log_that_was_closed_is_like_any_other(tmp_path: Path) -> None:
    path, ends = tmp_path / "a.mcap", []
    with LiveMcapWriter(path, "some-robot", 99.0) as writer:
        fill(writer, ends)
    found, source = read(path)
    assert source.preset == "some-robot"
    assert not source.problems.counts
    assert sum(isinstance(m, WheelAngles) for m in found) == SYNCS * EACH
    with Reader(path) as reader:  # as rosbags opens it, which wants a sound summary
        assert reader.message_count == SYNCS * (EACH + 1) + 1
        assert next(reader.messages())[1] == 99 * 10**9
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_all_is_on_the_disk_after_each_sync(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LiveMcapWriter(path, "imp", 99.0) as writer:
        assert path.stat().st_size == writer.size > 0  # the preset
        for number in range(3):
            writer.write(wheels(number))
            before = path.stat().st_size
            writer.sync()
            assert before < path.stat().st_size == writer.size
            assert numbers(path) == list(range(number + 1))
            writer.sync()  # with nothing to write
            assert path.stat().st_size == writer.size


def test_cut_anywhere_what_was_synced_is_there(
    killed: tuple[bytes, list[int]], tmp_path: Path
) -> None:
    content, ends = killed
    near = {end + d for end in ends for d in range(-20, 60)}
    for where in sorted(near | set(range(0, len(content), 97))):
        if where <= len(content):
            assert_whole_chunks(tmp_path / "b.mcap", content[:where], where, ends)


def test_zeroed_from_anywhere_what_was_synced_is_there(
    killed: tuple[bytes, list[int]], tmp_path: Path
) -> None:
    content, ends = killed
    near = {end + d for end in ends[1:] for d in range(-20, 60)}
    for where in sorted(near | set(range(ends[0], len(content), 97))):
        if where < len(content):
            zeroed = content[:where] + bytes(len(content) - where + 5000)
            assert_whole_chunks(tmp_path / "b.mcap", zeroed, where, ends)


@FUZZ
@given(data=st.data())
def test_data_after_the_last_sync_are_left_out(
    killed: tuple[bytes, list[int]], tmp_path: Path, data: st.DataObject
) -> None:
    content, ends = killed
    where = data.draw(st.integers(ends[0], len(content)))
    hole = data.draw(st.integers(0, 4096))  # blocks that were never written, then some that were
    torn = content[:where] + bytes(hole) + content[where + hole :]
    torn += data.draw(st.binary(max_size=300))
    path = tmp_path / "b.mcap"
    path.write_bytes(torn)
    synced = sum(end <= where for end in ends)
    kept = numbers(path)
    assert kept[: EACH * synced] == list(range(EACH * synced))


@pytest.mark.parametrize("footer", [b"", b"\2\x14" + bytes(7) + b"\xff" * 8 + bytes(12)])
def test_data_that_end_like_a_complete_file_are_left_out(
    killed: tuple[bytes, list[int]], tmp_path: Path, footer: bytes
) -> None:
    """With the magic, and with a footer whose summary is nowhere."""
    content, ends = killed
    torn = content[: ends[2] + 100] + footer + MAGIC
    assert_whole_chunks(tmp_path / "b.mcap", torn, ends[2] + 100, ends)


def test_a_flipped_bit_is_never_taken_for_data(
    killed: tuple[bytes, list[int]], tmp_path: Path
) -> None:
    content, ends = killed
    path = tmp_path / "b.mcap"
    for where in range(ends[2] + 9 + 28 + 16, ends[3], 41):  # in the fourth chunk or its index
        flipped = bytearray(content)
        flipped[where] ^= 0x10
        path.write_bytes(flipped)
        assert numbers(path)[: EACH * 3] == list(range(EACH * 3))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    with pytest.raises(SourceError, match="already exists"):
        LiveMcapWriter(path, "imp", 1.0).__enter__()
    assert path.read_text() == "precious"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    with pytest.raises(SourceError, match="cannot be written"):
        LiveMcapWriter(tmp_path / "no" / "a.mcap", "imp", 1.0).__enter__()


def test_a_log_is_being_written_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LiveMcapWriter(path, "imp", 1.0):
        assert is_being_written(path)
        assert is_being_written(path)  # asking does not take it
    assert not is_being_written(path)
    assert not is_being_written(tmp_path / "missing.mcap")


def test_a_moved_log_is_detected(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LiveMcapWriter(path, "imp", 1.0) as writer:
        assert writer.in_place
        path.rename(tmp_path / "b.mcap")
        assert not writer.in_place
        path.touch()
        assert not writer.in_place


def failing(code: int) -> Callable[[int], None]:
    def sync(descriptor: int) -> None:
        raise OSError(code, os.strerror(code))

    return sync


@pytest.mark.parametrize("when", ["begin", "middle", "end"])
def test_disk_errors_are_raised_and_leave_a_readable_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    path = tmp_path / "a.mcap"
    if when == "begin":
        monkeypatch.setattr(live_recording, "_sync_data", failing(errno.ENOSPC))

    def write() -> None:
        with LiveMcapWriter(path, "imp", 99.0) as writer:
            writer.write(wheels(0))
            writer.sync()
            monkeypatch.setattr(live_recording, "_sync_data", failing(errno.ENOSPC))
            if when == "middle":
                writer.sync()

    with pytest.raises(OSError, match="No space"):
        write()
    assert not is_being_written(path)
    if when == "begin":
        assert list(tmp_path.iterdir()) == []
    else:
        assert numbers(path) == [0]
        assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_message_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LiveMcapWriter(path, "imp", 1.0) as writer:
        with pytest.raises(struct.error):  # in the second of its two topics
            writer.write(Climate(2.0, 20.0, "wet"))  # type: ignore[arg-type]
        writer.write(Event(2.0, "info", "test", "good"))
    with Reader(path) as reader:
        assert {c.topic for c in reader.connections} == {"/impslam/preset", "/rosout"}
