"""What unpacks to more than it may is refused in one line, before the memory is taken."""

import gzip
import os
import shutil
import socket
import sqlite3
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy.io import savemat
from tests.sources.bags import ROS1, ROS2, bag, scan
from tests.sources.logs import read

from impslam.errors import SourceError
from impslam.sources.base import recognise
from impslam.sources.unpack import (
    TOGETHER_LIMIT,
    UNIT_LIMIT,
    LimitError,
    unpack_lz4,
    unpack_zstd,
    zstd,
)

SCAN = "sensor_msgs/msg/LaserScan"
MB = 1_000_000
LARGE = bytes(160 * MB)
ROOM = 2 * UNIT_LIMIT + 20 * MB  # decompressors join what they put out


def read_in_little_memory(log: Path, room: int = ROOM) -> tuple[list[Any], Any]:
    """Read a log, and check that it never takes more than so many bytes."""
    tracemalloc.start()
    try:
        return read(log)
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < room


def refused(log: Path, *parts: str, room: int = ROOM) -> None:
    with pytest.raises(SourceError) as error:
        read_in_little_memory(log, room)
    said = str(error.value)
    assert said.startswith(str(log))
    assert "\n" not in said
    assert len(said) < 400
    for part in parts:
        assert part in said


def mcap(path: Path, write: Callable[[Writer2, Any], None], mode: CompressionMode | None) -> Path:
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        write(writer, writer.add_connection("/scan", SCAN, typestore=ROS2))
    return path


def single(folder: Path) -> Path:
    return next(folder.glob("*.mcap"))


@pytest.mark.parametrize("as_folder", [False, True])
@pytest.mark.parametrize("mode", [CompressionMode.STORAGE, None])
def test_an_mcap_with_a_large_chunk(tmp_path: Path, mode, as_folder: bool) -> None:
    folder = mcap(tmp_path / "log", lambda w, c: w.write(c, 1, LARGE), mode)
    if mode is not None:
        assert single(folder).stat().st_size < MB / 10
    refused(folder if as_folder else single(folder), "64 MB", "check its origin")


@pytest.mark.parametrize("size", [1, 100 * MB])
def test_an_mcap_with_a_wrong_chunk_size(tmp_path: Path, size: int) -> None:
    """Whatever it says, no more than the limit is unpacked."""

    def write(writer: Writer2, connection: Any) -> None:
        writer.write(connection, 1, LARGE)

    log = single(mcap(tmp_path / "log", write, CompressionMode.STORAGE))
    content = log.read_bytes()
    true = struct.pack("<Q", len(LARGE) + 4 + 22 + 9)
    log.write_bytes(content.replace(true, struct.pack("<Q", size)))
    with pytest.raises(SourceError, match="64 MB"):
        read_in_little_memory(log)


def test_an_mcap_with_chunks_that_overlap(tmp_path: Path) -> None:
    def write(writer: Writer2, connection: Any) -> None:
        for k in range(1 + TOGETHER_LIMIT // (10 * MB)):
            writer.write(connection, k, b"")
            writer.write(connection, 10**9 + k, LARGE[: 10 * MB])

    folder = mcap(tmp_path / "log", write, CompressionMode.STORAGE)
    refused(single(folder), "chunks whose times overlap", "256 MB")


def test_a_long_mcap_is_read_in_little_memory(tmp_path: Path) -> None:
    def write(writer: Writer2, connection: Any) -> None:
        for k in range(40):
            writer.write(connection, 10**9 * k, LARGE[: 10 * MB])

    log = single(mcap(tmp_path / "log", write, CompressionMode.STORAGE))
    _, source = read_in_little_memory(log, 60 * MB)
    assert source.problems.counts["malformed scan message"] == 40


def test_an_mcap_with_endless_names(tmp_path: Path) -> None:
    """Schemas in chunks, as a log has them that lacks its end."""
    log = single(mcap(tmp_path / "log", lambda w, c: w.write(c, 1, b""), None))
    start = log.read_bytes()[:8]
    head = b"\x01" + struct.pack("<QI", 8 + 4, 4) + b"ros2" + struct.pack("<I", 0)
    chunks = []
    for k in range(1, 10):
        text = struct.pack("<I", 10 * MB) + bytes(10 * MB)
        schema = struct.pack("<HI", k, 1) + b"a" + struct.pack("<I", 0) + text
        chunk = b"\x03" + struct.pack("<Q", len(schema)) + schema
        packed = zstd.compress(chunk)
        record = struct.pack("<QQQII", 0, 0, len(chunk), 0, 4) + b"zstd"
        record += struct.pack("<Q", len(packed)) + packed
        chunks.append(b"\x06" + struct.pack("<Q", len(record)) + record)
    log.write_bytes(start + head + b"".join(chunks))
    assert log.stat().st_size < MB / 10
    refused(log, room=200 * MB)


@pytest.mark.parametrize("form", [Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4])
def test_a_ros_1_bag_with_a_large_chunk(tmp_path: Path, form) -> None:
    log = tmp_path / "a.bag"
    writer = Writer1(log)
    writer.set_compression(form)
    with writer:
        writer.write(writer.add_connection("/scan", SCAN, typestore=ROS1), 1, LARGE)
    assert log.stat().st_size < MB
    refused(log, "64 MB")


def test_a_ros_2_bag_with_a_large_message(tmp_path: Path) -> None:
    folder = mcap(tmp_path / "log", lambda w, c: w.write(c, 1, LARGE), CompressionMode.MESSAGE)
    refused(folder, "64 MB")


def test_a_ros_2_bag_that_unpacks_to_more_than_the_disk(tmp_path: Path, monkeypatch) -> None:
    folder = mcap(tmp_path / "log", lambda w, c: w.write(c, 1, LARGE), CompressionMode.FILE)
    assert next(folder.glob("*.zstd")).stat().st_size < MB / 10
    usage = shutil.disk_usage(tmp_path)._replace(free=10 * MB)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    refused(folder, "mcap.zstd, which needs temporary disk space of more than 5 MB")


def database(path: Path, *statements: str) -> Path:
    """A bag of SQLite, one scan in it, changed by hand."""
    folder = bag(path, ("/scan", scan(ROS2)))
    with sqlite3.connect(next(folder.glob("*.db3"))) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()
    return folder


def test_a_database_with_a_large_message(tmp_path: Path) -> None:
    folder = database(tmp_path / "a", "INSERT INTO messages VALUES(9, 1, 1, zeroblob(99000000))")
    _, source = read_in_little_memory(folder)
    assert "too big" in source.problems.examples["damaged file"]


@pytest.mark.parametrize(
    "statements",
    [
        ["ALTER TABLE messages ADD COLUMN more BLOB AS (zeroblob(900000000))"],
        [
            "DROP TABLE message_definitions",
            "CREATE VIEW message_definitions AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL "
            "SELECT i+1 FROM n) SELECT i AS id, 'a' AS topic_type, 'ros2msg' AS encoding, "
            "hex(zeroblob(1000)) AS encoded_message_definition, '' AS type_description_hash FROM n",
        ],
    ],
)
def test_a_database_that_computes(tmp_path: Path, statements) -> None:
    refused(database(tmp_path / "a", *statements), "is computed, not recorded")


def test_several_streams_are_unpacked_as_one() -> None:
    assert unpack_zstd(zstd.compress(b"ab") + zstd.compress(b"c")) == b"abc"
    assert unpack_lz4(lz4.frame.compress(b"ab") + lz4.frame.compress(b"c")) == b"abc"
    with pytest.raises(EOFError):
        unpack_zstd(zstd.compress(b"abcdefgh")[:-2])
    assert unpack_zstd(zstd.compress(b"abc"), 3) == b"abc"
    with pytest.raises(LimitError):
        unpack_zstd(zstd.compress(b"abcd"), 3)


# --------------------------------------------------------------------------- MATLAB files


def mat(path: Path, **more: Any) -> Path:
    """A file that has what the car's logs have, and more."""
    row = np.zeros(3)
    names = ["u", "time", "zt", "TLsr"]
    savemat(path, dict.fromkeys(names, row) | more, do_compression=True)
    return path


def test_a_matlab_file_that_unpacks_to_too_much(tmp_path: Path) -> None:
    log = mat(tmp_path / "a.mat", time=np.zeros(20_000_000))
    assert log.stat().st_size < MB
    refused(log, "a.mat: unpacks to more than 64 MB", room=30 * MB)


def test_a_folder_with_a_large_matlab_file(tmp_path: Path) -> None:
    mat(tmp_path / "a.mat", time=np.zeros(20_000_000))
    refused(tmp_path, "no known log format", room=30 * MB)


# --------------------------------------------------------------------------- text


def test_endless_words_are_not_kept(tmp_path: Path) -> None:
    log = tmp_path / "a.log.gz"
    with gzip.open(log, "wt", compresslevel=1) as file:
        file.write("ODOM 0 0 0 0 0 0 1.0 host 0\nFLASER 1 1 0 0 0 0 0 0 2.0 host 0\n" * 9)
        file.writelines(f"{k:x}\n" for k in range(300_000))
    tracemalloc.start()
    with recognise(log)(path=log) as source:
        streams = {stream.name: stream.count for stream in source.streams()}
    assert tracemalloc.get_traced_memory()[1] < 3 * MB
    tracemalloc.stop()
    assert streams["ODOM"] == 18  # poses of FLASER lines among them
    assert sum(streams.values()) == 300_027


def test_a_scan_of_more_beams_than_any_lidar_has(tmp_path: Path) -> None:
    log = bag(tmp_path / "a.mcap", ("/scan", scan(ROS2, n=200_000)), ("/scan", scan(ROS2, n=9)))
    found, source = read(log)
    assert [len(message.ranges) for message in found] == [9]
    assert "200000 beams" in source.problems.examples["malformed scan message"]


# --------------------------------------------------------------------------- no files


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    return path


def test_a_pipe_is_rejected(tmp_path: Path, pipe: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("socket")
        for path in (pipe, Path("socket"), Path("/dev/zero"), Path("/dev/null")):
            refused(path, "is neither a file nor a folder")


def test_a_folder_with_a_pipe_for_a_file(tmp_path: Path, pipe: Path) -> None:
    folder = bag(tmp_path / "a", ("/scan", scan(ROS2)))
    file = next(folder.glob("*.db3"))
    file.unlink()
    pipe.rename(file)
    refused(folder, "is neither a file nor a folder")
