"""Writing a log that survives its program and the power: whole up to the last time it was synced."""

from __future__ import annotations

import os
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Self

from rosbags.rosbag2.storage_mcap import McapWriter as McapStorage

from impslam.errors import SourceError
from impslam.sources.recording import McapWriter
from impslam.sources.ros_build import nanoseconds

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd  # which rosbags depends on
if sys.platform != "win32":
    import fcntl

_CHECKED: dict[int, int] = {zstd.CompressionParameter.checksum_flag: 1}
_sync_data = getattr(os, "fdatasync", os.fsync)  # not everywhere; its size is part of the data


class TakenError(SourceError):
    """A log of this name exists already."""


class LiveMcapWriter(McapWriter):
    """Writes a log that grows under its final name; all that was written is safe after `sync`.

    What is cut off or zeroed behind that, by a kill or a power loss, is recognised in reading: each
    chunk carries a checksum. While it is written the file is locked (flock), so that every
    process can tell, and the lock goes with the writer, however that ends. Leaving the context
    writes the summary that makes it a log like any other; errors of the disk come as `OSError`.

    Parameters
    ----------
    path : file to write; it must not exist
    preset : name of the robot's preset, written first, on a latched topic
    begin : s, when the log begins; no message is logged before
    """

    def __init__(self, path: Path, preset: str, begin: float) -> None:
        super().__init__(path, preset)
        self._clock = nanoseconds(begin)
        self._synced = 0

    def __enter__(self) -> Self:
        """Begin the log in a hidden folder and move it to its place once it can be opened."""
        super().__enter__()
        with self._folder:  # rosbags writes folders; no trace of it stays, whatever happens later
            try:
                self._storage.compressor = lambda data: zstd.compress(data, options=_CHECKED)
                _lock(self._file)
                self._write_preset()
                self.sync()
                self._take_place()
            except BaseException:
                self._writer.abort()
                raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            with suppress(OSError):  # closing tries once more to write what could not be written
                self._writer.abort()
            return
        folder = self._writer.path  # where rosbags wants to put its metadata.yaml
        with os.fdopen(os.dup(self._file.fileno()), "rb") as still_open:  # and locked
            try:
                self.sync()
                folder.mkdir(parents=True)
                self._writer.close()
                os.fsync(still_open.fileno())
            except BaseException:
                with suppress(OSError):
                    self._writer.abort()
                raise
            finally:
                shutil.rmtree(folder.parent, ignore_errors=True)

    def sync(self) -> None:
        """Close the chunk and see all that was written safely to the disk."""
        if self._storage.chunk.msgs:
            self._storage.close_chunk()
        self._file.flush()
        _sync_data(self._file.fileno())
        self._synced = self._file.tell()

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._file.tell()

    @property
    def in_place(self) -> bool:
        """Whether the log is where it was begun, and whole; one that was deleted goes on unseen."""
        try:
            there, ours = self._path.stat(), os.fstat(self._file.fileno())
            return os.path.samestat(there, ours) and there.st_size >= self._synced
        except FileNotFoundError:
            return False

    @property
    def _storage(self) -> McapStorage:
        storage = self._writer.storage
        assert isinstance(storage, McapStorage)
        return storage

    @property
    def _file(self) -> BinaryIO:
        return self._storage.bio

    def _take_place(self) -> None:
        try:
            self._path.open("xb").close()  # so that nothing is ever overwritten
        except FileExistsError:
            raise TakenError(f"{self._path}: exists already; choose another name") from None
        self._storage.path.replace(self._path)
        if sys.platform != "win32":
            folder = os.open(self._path.parent, os.O_RDONLY)
            try:
                with suppress(OSError):  # not every file system can
                    os.fsync(folder)  # the name, too, should survive
            finally:
                os.close(folder)


def _lock(file: BinaryIO) -> None:
    if sys.platform != "win32":
        with suppress(OSError):  # not every file system can
            fcntl.flock(file, fcntl.LOCK_EX)


def is_being_written(path: Path) -> bool:
    """Tell whether a `LiveMcapWriter`, of this process or another one, is writing the file."""
    if sys.platform == "win32":
        return False  # there a file that is open can be neither moved nor deleted
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # it has vanished, or cannot be read
        return False
    return False
