"""The ROS 1 bag reader of rosbags with size limits, and with support for bags without a usable index.

The index is written when a bag is closed. A bag whose recorder was killed (`.bag.active`), or that was
truncated, is a sequence of complete chunks; the last one may be open, with a length that is still 0
(wiki.ros.org/Bags/Format/2.0).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from rosbags import rosbag1
from rosbags.interfaces import Connection
from rosbags.rosbag1.reader import (
    Chunk,
    Header,
    IndexData,
    ReaderError,
    RecordType,
    decompressors,
    read_uint32,
)

from impslam.sources.folders import numbered_pieces
from impslam.sources.unpack import UNIT_LIMIT, check_size, unpack_bz2, unpack_lz4

_BOUNDED: dict[Callable[[bytes], bytes], Callable[[bytes], bytes]] = {
    decompressors["bz2"]: unpack_bz2,
    decompressors["lz4"]: unpack_lz4,
}
_INDEX_ENTRY = 12  # bytes: time and offset of a message


class BoundedReader1(rosbag1.Reader):
    """A ROS 1 bag with a size limit for chunks; a bag without an index is scanned."""

    is_cut = False

    def open(self) -> None:
        """Open the bag and read its index, or create one."""
        try:
            super().open()
        except (ReaderError, AssertionError) as error:
            damaged = str(error).startswith(("Bag is not indexed", "Bag index looks"))
            wrong_size = isinstance(error, AssertionError)  # see `_following`
            if not (damaged or wrong_size):
                raise
            self.is_cut = damaged
            self.bio = self.path.open("rb")
            try:
                self._scan()
            except BaseException:
                self.close()
                raise

    def read_chunk(self) -> Chunk:
        """Read the header of a chunk."""
        chunk = super().read_chunk()
        check_size("a chunk", chunk.datasize)
        return chunk._replace(decompressor=_BOUNDED.get(chunk.decompressor, chunk.decompressor))

    def _scan(self) -> None:
        """Create the index from all complete chunks."""
        file = self.bio
        assert file is not None
        size = file.seek(0, 2)
        file.seek(0)
        file.readline()  # the magic
        end = _following(file)
        indexes: dict[int, list[IndexData]] = {}
        while end < size:
            file.seek(end)
            try:
                op = Header.read(file).get_uint8("op")
                is_chunk, place = op == RecordType.CHUNK, file.seek(end)
                end = self._scan_chunk(file, place, indexes) if is_chunk else _following(file)
            except (ReaderError, ValueError):
                break  # truncated within a record, or arbitrary data after the end
        self.indexes = {c.id: sorted(indexes.get(c.id, [])) for c in self.connections}
        counted = [c._replace(msgcount=len(self.indexes[c.id])) for c in self.connections]
        self.connections = counted

    def _scan_chunk(self, file: BinaryIO, place: int, indexes: dict[int, list[IndexData]]) -> int:
        """Index the messages of the chunk at an offset in the file; return the offset of its end."""
        chunk = self.read_chunk()
        file.seek(chunk.datapos)
        data = file.read(chunk.datasize or UNIT_LIMIT)
        is_open = not chunk.datasize or len(data) < chunk.datasize
        if is_open and chunk.decompressor is not decompressors["none"]:
            raise ReaderError("The last chunk is not complete.")
        try:
            self.bio = BytesIO(chunk.decompressor(data))
            whole = self._scan_records(self.bio, place, indexes)
        except (EOFError, OSError, RuntimeError):  # a damaged chunk between complete ones
            whole = 0
        finally:
            self.bio = file
        self.chunks[place] = chunk._replace(datasize=whole) if is_open else chunk
        return chunk.datapos + (whole if is_open else chunk.datasize)

    def _scan_records(
        self, records: BytesIO, chunk: int, indexes: dict[int, list[IndexData]]
    ) -> int:
        """Index the records of an unpacked chunk; return the length of the complete ones."""
        known, size, at = {c.id for c in self.connections}, len(records.getbuffer()), 0
        while at < size:
            records.seek(at)
            try:
                header = Header.read(records)
                op = header.get_uint8("op")
                following = records.tell() + 4 + read_uint32(records)
                if following > size or op not in (RecordType.MSGDATA, RecordType.CONNECTION):
                    break
                if op == RecordType.MSGDATA:
                    entry = IndexData(header.get_time("time"), chunk, at)
                    indexes.setdefault(header.get_uint32("conn"), []).append(entry)
                elif header.get_uint32("conn") not in known:
                    records.seek(at)
                    self.connections.append(self.read_connection())
                    known.add(self.connections[-1].id)
            except (ReaderError, ValueError):
                break
            at = following
        return at


class SplitReader1:
    """A folder with the pieces of a ROS 1 bag, as written by `rosbag record --split`."""

    def __init__(self, path: Path) -> None:
        self._pieces = [BoundedReader1(piece) for piece in self.pieces(path)]
        self._stack = ExitStack()
        self._merged: dict[tuple[str, str], Connection] = {}

    @staticmethod
    def pieces(path: Path) -> list[Path]:
        """Return the pieces in order; none if the folder contains other bags."""
        found = [file for file in path.glob("*.bag") if file.is_file()]
        return numbered_pieces(found) if len(found) > 1 else []

    def open(self) -> None:
        """Open the pieces."""
        try:
            for piece in self._pieces:
                piece.open()
                self._stack.callback(piece.close)
        except BaseException:
            self.close()
            raise
        self._merged = merged(self._pieces)

    def close(self) -> None:
        """Close the pieces."""
        self._stack.close()

    @property
    def is_cut(self) -> bool:
        """Whether a piece is truncated."""
        return any(piece.is_cut for piece in self._pieces)

    @property
    def connections(self) -> list[Connection]:
        """One connection for each topic and type."""
        return list(self._merged.values())

    def messages(
        self, connections: Collection[Connection]
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield (connection, log time in ns, data), piece by piece."""
        wanted = {(c.topic, c.msgtype) for c in connections}
        for piece in self._pieces:
            own = [c for c in piece.connections if (c.topic, c.msgtype) in wanted]
            for connection, time, data in piece.messages(own) if own else ():
                yield self._merged[connection.topic, connection.msgtype], time, data


def merged(pieces: Iterable[Any]) -> dict[tuple[str, str], Connection]:
    """Return the connections of all pieces of a bag, one for each topic and type."""
    known: dict[tuple[str, str], Connection] = {}
    for connection in (c for piece in pieces for c in piece.connections):
        name = connection.topic, connection.msgtype
        before = known[name].msgcount if name in known else 0
        count = connection.msgcount + before
        known[name] = known.get(name, connection)._replace(msgcount=count)
    return known


def _following(file: BinaryIO) -> int:
    """Return the offset of the end of the record at the current offset.

    Recorders of 2010 state a wrong size for index records, which ROS ignores: the count is right.
    """
    header = Header.read(file)
    size = read_uint32(file)
    if header.get_uint8("op") == RecordType.IDXDATA:
        size = _INDEX_ENTRY * header.get_uint32("count")
    return file.tell() + size
