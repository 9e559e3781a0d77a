"""The readers of rosbags for ROS 2, within limits, and for MCAP files that lack their end."""

from __future__ import annotations

import re
import shutil
import struct
import tempfile
from collections.abc import Collection, Generator, Iterator
from contextlib import ExitStack
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, cast

from rosbags.interfaces import Connection
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import ReaderMetadata
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import (
    DECOMPRESSORS,
    Channel,
    McapReader,
    Schema,
    decompress,
    read_string,
)
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from impslam.sources.unpack import (
    UNIT_LIMIT,
    check_size,
    check_together,
    check_unpacked,
    unpack_lz4,
    unpack_zstd,
)

# rosbags unpacks a chunk whatever comes out, and looks at its size afterwards.
DECOMPRESSORS.update(
    lz4=lambda data, size: unpack_lz4(data, _declared(size)),
    zstd=lambda data, size: unpack_zstd(data, _declared(size)),
)

_NO_RECORD, _CHUNK, _DATA_END = 0x00, 0x06, 0x0F  # opcodes; the last ends an MCAP file's data


def _declared(size: int) -> int:
    check_size("a chunk", size)
    return UNIT_LIMIT  # what is less, or more, than was declared is damage, which rosbags tells


class BoundedFile(BufferedReader):
    """A file of records, which are read one at a time."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read a record, or a part of one; none is as long as a file may say that it is."""
        check_size("a record", size or 0)
        return super().read(size)


class Definitions(dict[int, Any]):
    """The schemas or channels of an MCAP file by id; what they hold together is bounded."""

    _size = 0

    def __setitem__(self, key: int, value: Schema | Channel) -> None:
        """Take one; recorders repeat them in each chunk."""
        self._size += _length(value) - (_length(self[key]) if key in self else 0)
        check_size("a list of topics", self._size)
        super().__setitem__(key, value)

    def clear(self) -> None:
        """Forget them all."""
        self._size = 0
        super().clear()


def _length(value: Schema | Channel) -> int:
    return sum(len(part) for part in value if isinstance(part, str | bytes))


class CutMcapReader(McapReader):
    """An MCAP file that may lack its end, as a robot leaves it that loses power.

    Then it is read up to the last whole record, by scanning; rosbags alone refuses such files.
    """

    is_cut = False

    def _open(self) -> None:
        self.bio = BoundedFile(cast("BufferedReader", self.bio).detach())
        self.schemas, self.channels = Definitions(), Definitions()
        try:
            super()._open()
        except ReaderError as error:
            if "end magic" not in str(error):
                raise
            self._scan()
        spans = [
            (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size)
            for chunk in self.chunks
        ]
        check_together(spans)

    def _scan(self) -> None:
        assert self.bio is not None
        self.data_end = _end_of_whole_records(self.bio, self.data_start)
        try:
            self.meta_scan()
        except Exception:  # rosbags raises anything; what lies behind the last sync may be anything
            self.data_end = _end_of_sound_records(self.bio, self.data_start, self.data_end)
            for found in (self.schemas, self.channels, self.connections):
                found.clear()
            self.meta_scan()
        counts = self.statistics.channel_message_counts if self.statistics else {}
        self.connections = [c._replace(msgcount=counts.get(c.id, 0)) for c in self.connections]
        self.is_cut = True


def _records(file: BinaryIO, start: int) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, offset behind it) of each whole record before the end of the data."""
    size, offset = file.seek(0, 2), start
    while True:
        file.seek(offset)
        head = file.read(9)  # opcode, length of the content in 8 bytes
        following = offset + 9 + int.from_bytes(head[1:], "little")
        if len(head) < 9 or following > size or head[0] in (_NO_RECORD, _DATA_END):
            return
        yield head[0], offset, following
        offset = following


def _end_of_whole_records(file: BinaryIO, start: int) -> int:
    """Return the offset behind the last whole record."""
    return max((following for _, _, following in _records(file, start)), default=start)


def _end_of_sound_records(file: BinaryIO, start: int, end: int) -> int:
    """Return the offset of the first record that is not what it says it is, at most `end`.

    A power loss leaves a file of the right length, whose last blocks may be zeros or anything.
    """
    for opcode, offset, following in _records(file, start):
        if offset >= end:
            break
        file.seek(offset + 9)
        try:
            if opcode == _CHUNK:
                _check_chunk(file.read(following - offset - 9))
        except Exception:  # rosbags raises anything on damaged data
            return offset
    return end


def _check_chunk(content: bytes) -> None:
    """Raise anything unless the chunk can be unpacked into whole records."""
    *_, size, crc = struct.unpack_from("<QQQI", content)
    body = BytesIO(content[28:])
    compression = read_string(body)
    body.read(8)  # size of the rest
    records = BytesIO(decompress(body.read(), compression, size, crc))
    if _end_of_whole_records(records, 0) != size:
        raise ReaderError("The chunk ends within a record.")


class PlainSqlite3Reader(Sqlite3Reader):
    """An SQLite file that holds what it gives: nothing is computed while it is read."""

    def _open(self) -> None:
        assert self.dbconn is not None
        self.dbconn.limit(_SQLITE_LIMIT_LENGTH, UNIT_LIMIT)
        if strange := next(self.dbconn.execute(_COMPUTED), None):
            raise ReaderError(f"{strange[0]!r} is computed, not recorded.")
        super()._open()


_SQLITE_LIMIT_LENGTH = 0  # of a text or a blob
_COMPUTED = """
    SELECT m.name FROM sqlite_master m LEFT JOIN pragma_table_xinfo(m.name) c
    WHERE m.type NOT IN ('table', 'index') OR m.sql LIKE 'CREATE VIRTUAL%' OR c.hidden LIMIT 1"""


class BagFolder(DirectoryReader):
    """A ROS 2 bag: a folder of files of one kind, as its metadata.yaml tells."""

    is_cut = False
    STORAGE_PLUGINS = {"mcap": CutMcapReader, "sqlite3": PlainSqlite3Reader}  # noqa: RUF012

    def open(self) -> None:
        """Open the files; those that are compressed are unpacked into a temporary folder first."""
        for path in Path(str(self.path)).iterdir():
            if path.exists() and not (path.is_file() or path.is_dir()):
                raise ReaderError(f"{path.name!r} is neither a file nor a folder.")
            if path.suffix == ".zstd":
                check_unpacked(path, shutil.disk_usage(tempfile.gettempdir()).free // 2)
        super().open()
        self.is_cut = any(isinstance(f, CutMcapReader) and f.is_cut for f in self.storages)
        self._packs_messages = self.metadata.compression_mode == "message"
        self.metadata = self.metadata._replace(compression_mode=None)  # see `messages`

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield (connection, log time in ns, data)."""
        for connection, stamp, data in super().messages(connections, start, stop):
            yield connection, stamp, unpack_zstd(data) if self._packs_messages else data


class UnlistedFolder(BagFolder):
    """A ROS 2 bag whose recorder was stopped by force before it wrote metadata.yaml."""

    is_cut = True

    def __init__(self, path: Path) -> None:
        self.path, self.stack = path, None
        self.connections, self.files, self.storages = [], [], []
        self.metadata = ReaderMetadata(0, 2**63 - 1, 0, 0, None, None, None, None)
        self._packs_messages = False

    @staticmethod
    def pieces(path: Path) -> list[Path]:
        """Return the files of a bag by their numbers, NAME_0, NAME_1, ...; none if it holds others."""
        found = [file for suffix in _PIECES for file in path.glob(f"*{suffix}") if file.is_file()]
        names = {file: re.fullmatch(r"(.+)_(\d+)", file.stem) for file in found}
        numbers = {file: (name[1], int(name[2])) for file, name in names.items() if name}
        if len(found) > 1 and (
            len(numbers) < len(found) or len({n for n, _ in numbers.values()}) > 1
        ):
            return []
        return sorted(found, key=lambda file: numbers.get(file, ("", 0)))

    def open(self) -> None:
        """Open the files."""
        self.stack = ExitStack()
        try:
            for path in self.pieces(Path(str(self.path))):
                storage = _PIECES[path.suffix](path)
                storage.open()
                self.stack.callback(storage.close)
                self.storages.append(storage)
        except BaseException:
            self.close()
            raise
        known: dict[tuple[str, str], Connection] = {}
        for connection in (c for storage in self.storages for c in storage.connections):
            name = connection.topic, connection.msgtype
            before = known[name].msgcount if name in known else 0
            count = connection.msgcount + before
            known[name] = known.get(name, connection)._replace(msgcount=count)
        self.connections = list(known.values())


_PIECES: dict[str, Any] = {".mcap": CutMcapReader, ".db3": PlainSqlite3Reader}
