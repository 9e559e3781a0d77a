"""One face for the storages of rosbags: ROS 1 bags, ROS 2 folders, MCAP and SQLite files."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import McapReader, decompress, read_string
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from impslam.errors import SourceError


class CutMcapReader(McapReader):
    """An MCAP file that lacks its end, as a robot leaves it that loses power.

    Read up to the last whole record, by scanning; rosbags alone refuses such files.
    """

    is_cut = False

    def _open(self) -> None:
        try:
            super()._open()
        except ReaderError as error:
            if "end magic" not in str(error):
                raise
            self._scan()

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


Storage: TypeAlias = rosbag1.Reader | rosbag2.Reader | CutMcapReader | Sqlite3Reader
RosMessage: TypeAlias = Any  # classes that rosbags makes at run time from the log's definitions

_MAGIC: dict[bytes, Callable[[Path], Storage]] = {
    b"#ROSBAG V": rosbag1.Reader,
    b"\x89MCAP0\r\n": CutMcapReader,
    b"SQLite format 3\0": Sqlite3Reader,
}
_NO_RECORD, _CHUNK, _DATA_END = 0x00, 0x06, 0x0F  # opcodes; the last ends an MCAP file's data
_REPAIR = "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or copy it again"


def storage_class(path: Path) -> Callable[[Path], Storage] | None:
    """Return what reads a file, by its first bytes, or a folder, by its metadata.yaml."""
    if path.is_dir():
        return rosbag2.Reader if (path / "metadata.yaml").is_file() else None
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return None
    return next((cls for magic, cls in _MAGIC.items() if start.startswith(magic)), None)


def one_line(error: BaseException) -> str:
    """Return what an error of rosbags says, on one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


class Bag:
    """An open bag of any kind; `SourceError` if it cannot be opened."""

    def __init__(self, path: Path) -> None:
        make = storage_class(path)
        if make is None:
            raise SourceError(f"{path}: neither a ROS bag nor MCAP; see `imp list` for formats")
        try:
            self._storage = make(path)
            self._storage.open()
        except Exception as error:  # a damaged index leads rosbags to raise anything
            raise SourceError(f"{path}: cannot be opened ({one_line(error)}); {_REPAIR}") from None
        self.is_ros1 = make is rosbag1.Reader
        self.is_cut = isinstance(self._storage, CutMcapReader) and self._storage.is_cut

    def close(self) -> None:
        """Close the storage."""
        self._storage.close()

    @property
    def connections(self) -> list[Connection]:
        """What was recorded, one entry per topic and publisher."""
        return self._storage.connections

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield (connection, log time in ns, data) in the order of log time."""
        return self._storage.messages(connections)

    def decoder(self, connection: Connection) -> Callable[[bytes], RosMessage]:
        """Return what turns a connection's data into messages."""
        definition, kind = connection.msgdef, connection.msgtype
        store = _types(kind, definition.format, definition.data, self.is_ros1)
        if self.is_ros1:
            return lambda data: store.deserialize_ros1(data, kind)
        return lambda data: store.deserialize_cdr(data, kind)


@lru_cache(maxsize=32)
def _types(kind: str, form: MessageDefinitionFormat, text: str, is_ros1: bool) -> Typestore:
    """Return the definitions in the log, else those of the standard types."""
    with suppress(Exception):  # what rosbags cannot parse may be a standard type yet
        store = get_typestore(Stores.EMPTY)
        if form == MessageDefinitionFormat.MSG and text.strip():
            store.register(get_types_from_msg(text, kind))
        elif form == MessageDefinitionFormat.IDL:
            store.register(get_types_from_idl(text))
        store.get_msgdef(kind)
        return store
    return _standard_types(is_ros1)


@lru_cache
def _standard_types(is_ros1: bool) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
