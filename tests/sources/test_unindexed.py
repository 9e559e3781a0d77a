"""ROS 1 bags without an index: of a recorder that was stopped by force, or cut."""

import re
import struct
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer
from tests.sources.bags import ROS1, odometry, scan
from tests.sources.logs import read

from impslam.errors import SourceError
from impslam.types import LaserScan, OdometryPose

PACKINGS = [None, Writer.CompressionFormat.LZ4, Writer.CompressionFormat.BZ2]


def bag(path: Path, packing: Writer.CompressionFormat | None = None, count: int = 60) -> bytes:
    """Write scans and odometry in chunks of about ten messages; return the bytes of the bag."""
    writer = Writer(path)
    if packing is not None:
        writer.set_compression(packing)
    writer.chunk_threshold = 5000
    with writer:
        topics = [("/scan", "sensor_msgs/msg/LaserScan"), ("/odom", "nav_msgs/msg/Odometry")]
        known = [writer.add_connection(*topic, typestore=ROS1) for topic in topics]
        for i in range(count):
            for connection, message in zip(
                known, (scan(ROS1, 1.0 + i, n=50), odometry(ROS1)), strict=True
            ):
                data = ROS1.serialize_ros1(message, connection.msgtype)
                writer.write(connection, (100 + i) * 10**9, data)
    return path.read_bytes()


def without_index(data: bytes) -> bytes:
    """Return a bag as it is while it is recorded: the header says that there is no index."""
    at = data.index(b"index_pos=") + len(b"index_pos=")
    end = struct.unpack_from("<Q", data, at)[0]
    return data[:at] + bytes(8) + data[at + 8 : end]


def scans(path: Path) -> list[float]:
    return [m.stamp for m in read(path)[0] if isinstance(m, LaserScan)]


@pytest.mark.parametrize("packing", PACKINGS)
def test_all_of_an_unindexed_bag_is_read(
    tmp_path: Path, packing: Writer.CompressionFormat | None
) -> None:
    path = tmp_path / "log.bag.active"
    data = bag(path, packing)
    whole, _ = read(path)
    path.write_bytes(without_index(data))
    found, source = read(path)
    assert [(type(m), m.stamp) for m in found] == [(type(m), m.stamp) for m in whole]
    assert sum(isinstance(m, OdometryPose) for m in found) == 60
    assert source.problems.counts["cut file"] == 1
    assert "rosbag reindex" in source.problems.examples["cut file"]


def test_an_index_whose_records_state_a_wrong_size_is_read_by_its_counts(tmp_path: Path) -> None:
    """As recorded by ROS in 2010: 20 bytes for each entry of 12."""
    path = tmp_path / "log.bag"
    data = bytearray(bag(path))
    whole, _ = read(path)
    for index in re.finditer(rb"/\0\0\0\x04\0\0\0op=\x04", bytes(data)):
        start = index.start()
        count = struct.unpack_from("<I", data, data.index(b"count=", start) + 6)[0]
        assert struct.unpack_from("<I", data, start + 51)[0] == 12 * count
        struct.pack_into("<I", data, start + 51, 20 * count)
    path.write_bytes(data)
    found, source = read(path)
    assert [(type(m), m.stamp) for m in found] == [(type(m), m.stamp) for m in whole]
    assert "cut file" not in source.problems.counts


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize("share", [0.4, 0.7, 0.93])
def test_a_cut_bag_is_read_up_to_the_cut(
    tmp_path: Path, packing: Writer.CompressionFormat | None, share: float
) -> None:
    path = tmp_path / "log.bag"
    data = bag(path, packing)
    whole = scans(path)
    path.write_bytes(data[: int(share * len(data))])
    found = scans(path)
    assert found == whole[: len(found)]
    assert len(found) > share * len(whole) - 12


def last_chunk(data: bytes) -> tuple[int, int]:
    """Return where the header of the last chunk of a bag is, and where its content begins."""
    at, found = data.index(b"\n") + 1, (0, 0)
    while at < len(data):
        length = struct.unpack_from("<I", data, at)[0]
        body = at + 8 + length
        if b"op=\x05" in data[at : at + 4 + length]:
            found = at + 4, body
        at = body + struct.unpack_from("<I", data, body - 4)[0]
    return found


def test_the_open_chunk_of_a_recorder_is_read(tmp_path: Path) -> None:
    """Its length is 0 until it is closed; what follows it are its records."""
    path = tmp_path / "log.bag.active"
    data = without_index(bag(path))
    head, body = last_chunk(data)
    size = data.index(b"size=", head) + len(b"size=")
    end = body + struct.unpack_from("<I", data, body - 4)[0]
    zero = bytes(4)
    path.write_bytes(data[:size] + zero + data[size + 4 : body - 4] + zero + data[body:end])
    assert len(scans(path)) == 60
    path.write_bytes(path.read_bytes()[:-7])  # within the last message, which is odometry
    found, _ = read(path)
    assert len(found) == 119


def test_a_bag_without_complete_chunks_is_rejected_or_empty(tmp_path: Path) -> None:
    path = tmp_path / "log.bag"
    data = bag(path)
    path.write_bytes(data[:30])
    with pytest.raises(SourceError, match="cannot be opened"):
        read(path)
    path.write_bytes(without_index(data)[:5000])
    assert scans(path) == []
