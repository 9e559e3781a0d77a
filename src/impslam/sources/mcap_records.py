"""Finds the end of the complete and of the valid records in a truncated MCAP file."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import decompress, read_string

_NO_RECORD, _CHUNK, _DATA_END = 0x00, 0x06, 0x0F  # opcodes; the last one ends the data section


def _records(file: BinaryIO, start: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, begin, end) of each complete record before the end of the data."""
    size, offset = file.seek(0, 2), start
    while True:
        file.seek(offset)
        head = file.read(9)  # opcode, length of the content in 8 bytes
        following = offset + 9 + int.from_bytes(head[1:], "little")
        if len(head) < 9 or following > size or head[0] in (_NO_RECORD, _DATA_END):
            return
        yield head[0], offset, following
        offset = following


def end_of_complete_records(file: BinaryIO, start: int) -> int:
    """Return the offset of the end of the last complete record."""
    return max((following for _, _, following in _records(file, start)), default=start)


def end_of_valid_records(file: BinaryIO, start: int, end: int) -> int:
    """Return the offset of the first invalid record, at most `end`.

    A power loss may leave a file of the right length whose last blocks are zeros or arbitrary data.
    """
    for opcode, offset, following in _records(file, start):
        if offset >= end:
            break
        file.seek(offset + 9)
        try:
            if opcode == _CHUNK:
                _check_chunk(file.read(following - offset - 9))
        except Exception:  # rosbags may raise anything on damaged data
            return offset
    return end


def _check_chunk(content: bytes) -> None:
    """Raise an exception of any type unless the chunk can be unpacked into complete records."""
    *_, size, crc = struct.unpack_from("<QQQI", content)
    body = BytesIO(content[28:])
    compression = read_string(body)
    body.read(8)  # size of the rest
    records = BytesIO(decompress(body.read(), compression, size, crc))
    if end_of_complete_records(records, 0) != size:
        raise ReaderError("The chunk ends within a record.")
