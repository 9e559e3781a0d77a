"""Writes a log that survives a crash or a power loss: it is complete up to the last sync."""

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
_sync_data = getattr(os, "fdatasync", os.fsync)  # fdatasync, if available, also syncs the size


class LogExistsError(SourceError):
    """A log of this name exists already."""


class LiveMcapWriter(McapWriter):
    """Writes a log that grows under its final name; after `sync`, all data so far are safe.

    Later data that a kill or a power loss cut off or zeroed are detected when reading, because each chunk
    has a checksum. During writing the file is locked (flock), which any process can check; the lock ends
    with the writer's process. Leaving the context writes the summary, after which the log is like any
    other; disk errors are raised as `OSError`.

    Parameters
    ----------
    path : file to write; it must not exist
    preset : name of the robot's preset, written first, on a latched topic
    begin : start of the log, s; no message is logged earlier
    """

    def __init__(self, path: Path, preset: str, begin: float) -> None:
        super().__init__(path, preset)
        self._clock = nanoseconds(begin)
        self._synced = 0

    def __enter__(self) -> Self:
        """Start the log in a hidden folder and move it to its path once it can be opened."""
        super().__enter__()
        with self._folder:  # rosbags writes folders; this one is always removed
            try:
                self._storage.compressor = lambda data: zstd.compress(data, options=_CHECKED)
                _lock(self._file)
                self._write_preset()
                self.sync()
                self._move_to_path()
            except BaseException:
                self._writer.abort()
                raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            with suppress(OSError):  # closing retries the failed write
                self._writer.abort()
            return
        folder = self._writer.path  # rosbags writes its metadata.yaml there
        with os.fdopen(os.dup(self._file.fileno()), "rb") as still_open:  # keeps the lock
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
        """Close the chunk and flush all data to the disk."""
        if self._storage.chunk.msgs:
            self._storage.close_chunk()
        self._file.flush()
        _sync_data(self._file.fileno())
        self._synced = self._file.tell()

    @property
    def size(self) -> int:
        """Number of bytes written."""
        return self._file.tell()

    @property
    def in_place(self) -> bool:
        """Whether the log is still at its path and complete; writing to a deleted file does not fail."""
        try:
            found, ours = self._path.stat(), os.fstat(self._file.fileno())
            return os.path.samestat(found, ours) and found.st_size >= self._synced
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

    def _move_to_path(self) -> None:
        try:
            self._path.open(
                "xb"
            ).close()  # fails if the file exists, so that nothing is overwritten
        except FileExistsError:
            raise LogExistsError(f"{self._path}: already exists; choose another name") from None
        self._storage.path.replace(self._path)
        if sys.platform != "win32":
            folder = os.open(self._path.parent, os.O_RDONLY)
            try:
                with suppress(OSError):  # not supported by every file system
                    os.fsync(folder)  # make the name durable, too
            finally:
                os.close(folder)


def _lock(file: BinaryIO) -> None:
    if sys.platform != "win32":
        with suppress(OSError):  # not supported by every file system
            fcntl.flock(file, fcntl.LOCK_EX)


def is_being_written(path: Path) -> bool:
    """Return whether a `LiveMcapWriter`, in this process or another one, is writing the file."""
    if sys.platform == "win32":
        return False  # Windows does not let anyone move or delete an open file
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # it does not exist any more, or cannot be read
        return False
    return False
