"""The MCAP reader of rosbags with size limits, for truncated files and those without a profile, too."""

from __future__ import annotations

from io import BufferedReader
from typing import Any, cast

from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, Channel, McapReader, Schema, read_string

from impslam.sources.mcap_records import end_of_complete_records, end_of_valid_records
from impslam.sources.unpack import UNIT_LIMIT, check_size, check_together, unpack_lz4, unpack_zstd

_ENCODINGS = {"ros2msg", "ros2idl", "omgidl", ""}
"""Languages of the definitions of ROS 2 messages."""
MAGIC = b"\x89MCAP0\r\n"
_ENDS = ("end magic", "footer", "summary offset")
"""Words in the errors of rosbags about the end of a file; arbitrary data may end in the magic by chance."""
_PROFILE = 17
"""Offset of the profile: behind the magic, an opcode and the length of its record."""


class ForeignError(ReaderError):
    """An MCAP file contains other messages than those of ROS 2."""


# rosbags unpacks a chunk without a limit and checks its size only afterwards.
DECOMPRESSORS.update(
    lz4=lambda data, size: unpack_lz4(data, _declared(size)),
    zstd=lambda data, size: unpack_zstd(data, _declared(size)),
)


def _declared(size: int) -> int:
    check_size("a chunk", size)
    return UNIT_LIMIT  # rosbags reports a size that differs from the declared one


class BoundedFile(BufferedReader):
    """A file of records that are read one at a time, with a size limit."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read a record, or a part of one; raise `LimitError` if its declared size is too large."""
        check_size("a record", size or 0)
        return super().read(size)


class Definitions(dict[int, Any]):
    """The schemas or channels of an MCAP file by id, with a limit on their total size."""

    _size = 0

    def __setitem__(self, key: int, value: Schema | Channel) -> None:
        """Set a definition; recorders repeat them in each chunk.

        Raises
        ------
        ForeignError
            If it is not a definition of ROS 2.
        """
        if isinstance(value, Schema) and value.encoding not in _ENCODINGS:
            raise ForeignError(f"{value.name} is defined in {value.encoding}")
        self._size += _length(value) - (_length(self[key]) if key in self else 0)
        check_size("a list of topics", self._size)
        super().__setitem__(key, value)

    def clear(self) -> None:
        """Remove all definitions."""
        self._size = 0
        super().clear()


def _length(value: Schema | Channel) -> int:
    return sum(len(part) for part in value if isinstance(part, str | bytes))


class CutMcapReader(McapReader):
    """An MCAP file that may be truncated, e.g. after a robot's power loss.

    A truncated file is scanned and read up to the last complete record; rosbags alone rejects it. It also
    rejects files without a profile, as general MCAP libraries write them: they are scanned, too.
    """

    is_cut = False

    def _open(self) -> None:
        self.bio = BoundedFile(cast("BufferedReader", self.bio).detach())
        self.schemas, self.channels = Definitions(), Definitions()
        try:
            super()._open()
        except ReaderError as error:
            self.is_cut = any(part in str(error) for part in _ENDS)
            if not self.is_cut:
                self._accept_no_profile(error)
                self.bio.seek(-len(MAGIC), 2)
                self.is_cut = self.bio.read() != MAGIC
            self._scan()
        spans = [
            (chunk.message_start_time, chunk.message_end_time, chunk.uncompressed_size)
            for chunk in self.chunks
        ]
        check_together(spans)

    def _accept_no_profile(self, error: ReaderError) -> None:
        """Prepare to scan the file if its only defect is that it names no profile."""
        assert self.bio is not None
        if "Profile" not in str(error):
            raise error
        self.data_start = self.bio.tell()
        self.bio.seek(_PROFILE)
        if profile := read_string(self.bio):
            raise ForeignError(f"its profile is {profile}") from None

    def _scan(self) -> None:
        assert self.bio is not None
        self.data_end = end_of_complete_records(self.bio, self.data_start)
        try:
            self.meta_scan()
        except ForeignError:
            raise
        except Exception:  # rosbags may raise anything: data after the last sync are arbitrary
            self.data_end = end_of_valid_records(self.bio, self.data_start, self.data_end)
            for found in (self.schemas, self.channels, self.connections):
                found.clear()
            self.meta_scan()
        counts = self.statistics.channel_message_counts if self.statistics else {}
        self.connections = [c._replace(msgcount=counts.get(c.id, 0)) for c in self.connections]
