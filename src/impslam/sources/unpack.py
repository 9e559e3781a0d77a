"""Unpacks data with size limits, since a log of some kB may unpack to GB."""

from __future__ import annotations

import bz2
import shutil
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]

from impslam.errors import SourceError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd  # which rosbags depends on

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

UNIT_LIMIT = 64_000_000
"""Maximum size of a unit that is unpacked at once (a chunk, a record or a message), bytes. Recorders end a
chunk after 0.8 to 4 MB plus the current message; the largest, an uncompressed 4K picture, has 25 MB."""

TOGETHER_LIMIT = 256_000_000
"""Maximum total size of chunks in memory at once because their times overlap, bytes: 64 of 4 MB."""


class LimitError(SourceError):
    """A part of a log is larger than the limit for memory."""


def check_size(what: str, size: int, limit: int = UNIT_LIMIT) -> None:
    """Raise `LimitError` if `what` is larger than the limit."""
    if size > limit:
        raise LimitError(f"{what} of more than {limit / 1e6:.0f} MB")


def unpack(make: Callable[[], Any], data: bytes, limit: int = UNIT_LIMIT) -> bytes:
    """Unpack consecutive compressed streams; `make` returns a decompressor like that of bz2.

    Raises
    ------
    LimitError
        As soon as it is more than `limit` bytes.
    EOFError
        If the data ends within a stream.
    """
    parts, room = [], limit
    while data:
        decompressor = make()
        parts.append(decompressor.decompress(data, max_length=room + 1))
        room -= len(parts[-1])
        if room < 0:
            raise LimitError(f"a chunk or message that unpacks to more than {limit / 1e6:.0f} MB")
        if not decompressor.eof:
            raise EOFError("compressed data ends early")
        data = decompressor.unused_data or b""
    return b"".join(parts)


def unpack_zstd(data: bytes, limit: int = UNIT_LIMIT) -> bytes:
    """Unpack zstd frames."""
    return unpack(zstd.ZstdDecompressor, data, limit)


def unpack_lz4(data: bytes, limit: int = UNIT_LIMIT) -> bytes:
    """Unpack LZ4 frames."""
    return unpack(lz4.frame.LZ4FrameDecompressor, data, limit)


def unpack_bz2(data: bytes, limit: int = UNIT_LIMIT) -> bytes:
    """Unpack bz2 streams."""
    return unpack(bz2.BZ2Decompressor, data, limit)


def check_unpacked(path: Path, limit: int) -> None:
    """Raise `LimitError` if a file of zstd frames unpacks to more than the limit."""
    size = 0
    with zstd.open(path, "rb") as file:
        while size <= limit and (part := file.read(1 << 20)):
            size += len(part)
    check_size(f"{path.name}, which needs temporary disk space", size, limit)


def unpack_file(path: Path, folder: Path) -> Path:
    """Unpack a file of zstd frames to a folder, unless it has half the room of the disk or more."""
    check_unpacked(path, shutil.disk_usage(folder).free // 2)
    target = folder / path.stem
    with zstd.open(path, "rb") as packed, target.open("wb") as file:
        shutil.copyfileobj(packed, file)
    return target


def check_together(spans: Iterable[tuple[int, int, int]]) -> None:
    """Raise `LimitError` if chunks (first stamp, last stamp, bytes) need too much memory at once."""
    marks = []
    for first, last, size in spans:
        check_size("a chunk", size)
        marks += [(first, 0, size), (max(first, last), 1, -size)]  # at a tie, count both chunks
    size = 0
    for _, _, change in sorted(marks):
        size += change
        check_size("chunks whose times overlap, together", size, TOGETHER_LIMIT)
