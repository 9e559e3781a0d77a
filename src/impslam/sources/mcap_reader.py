"""The reader of rosbags for MCAP files, within limits, also for files that lack their end."""

from __future__ import annotations

from io import BufferedReader
from typing import Any, cast

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, Channel, McapReader, Schema

from impslam.sources.mcap_records import end_of_sound_records, end_of_whole_records
from impslam.sources.unpack import UNIT_LIMIT, check_size, check_together, unpack_lz4, unpack_zstd

# rosbags unpacks a chunk whatever comes out, and looks at its size afterwards.
DECOMPRESSORS.update(
    lz4=lambda data, size: unpack_lz4(data, _declared(size)),
    zstd=lambda data, size: unpack_zstd(data, _declared(size)),
)


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
        self.data_end = end_of_whole_records(self.bio, self.data_start)
        try:
            self.meta_scan()
        except Exception:  # rosbags raises anything; what lies behind the last sync may be anything
            self.data_end = end_of_sound_records(self.bio, self.data_start, self.data_end)
            for found in (self.schemas, self.channels, self.connections):
                found.clear()
            self.meta_scan()
        counts = self.statistics.channel_message_counts if self.statistics else {}
        self.connections = [c._replace(msgcount=counts.get(c.id, 0)) for c in self.connections]
        self.is_cut = True
