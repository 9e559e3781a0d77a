"""The logs on the robot's disk: what there is, and a recycle bin before anything is gone."""

from __future__ import annotations

import math
import os
import re
import stat
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from rosbags.rosbag2.storage_mcap import McapReader

from impslam.errors import ImpError
from impslam.sources.live_recording import is_being_written

BIN = ".bin"
_MAGIC = b"\x89MCAP0\r\n"
_BINNED = re.compile(r"[0-9]{8}T[0-9]{6}Z(?:-[0-9]+)?_(.+\.mcap)")  # when deleted, what it was
_STAMP = "%Y%m%dT%H%M%SZ"


class StoreError(ImpError):
    """A log that is not there, or may not be touched: what, where, what to do."""


@dataclass(frozen=True, slots=True)
class StoredLog:
    """A log on the disk.

    Attributes
    ----------
    name : file name
    size : bytes
    modified : s since 1970, when it was last written
    recording : whether it is being written
    cut : whether it lacks its end (power lost); `imp run` reads it up to there
    duration : s from the first message to the last, NaN where only reading it all would tell
    """

    name: str
    size: int
    modified: float
    recording: bool
    cut: bool
    duration: float


@dataclass(frozen=True, slots=True)
class BinnedLog:
    """A log in the recycle bin: `name` there, the name it had, bytes, and s since 1970 when deleted."""

    name: str
    original: str
    size: int
    deleted: float


class LogStore:
    """The logs in a folder; every method may be called from any thread.

    Only `.mcap` files that lie in the folder itself exist here: no links, no other folders.

    Parameters
    ----------
    folder : where logs are kept; it may be missing, and files may vanish at any time
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)
        self._bin = self._folder / BIN
        self._lock = threading.Lock()  # of moving files about
        self._known: dict[str, tuple[tuple[int, int], bool, float]] = {}

    def logs(self) -> list[StoredLog]:
        """Return the logs, newest first."""
        found = [self._look(name, status) for name, status in _files(self._folder)]
        return sorted(found, key=lambda log: (-log.modified, log.name))

    def path(self, name: str) -> Path:
        """Return the path of a log by its name in `logs()`; nothing else is ever returned.

        Raises
        ------
        StoreError
            If there is no such log in the folder.
        """
        return _within(self._folder, name)

    def delete(self, name: str) -> None:
        """Move a log to the recycle bin.

        Raises
        ------
        StoreError
            If there is no such log, it is being recorded, or the disk refuses.
        """
        with self._lock:
            log = self.path(name)
            if is_being_written(log):
                raise StoreError(
                    f"{name}: is being recorded; stop the recording before deleting it"
                )
            self._make_bin()
            stamp = datetime.now(UTC).strftime(_STAMP)
            target, number = self._bin / f"{stamp}_{name}", 1
            while target.exists():
                number += 1
                target = self._bin / f"{stamp}-{number}_{name}"
            _move(log, target)

    def bin(self) -> list[BinnedLog]:
        """Return what is in the recycle bin, last deleted first."""
        found = []
        for entry, status in _files(self._bin):
            with suppress(StoreError, ValueError):  # not put there by this store
                found.append(BinnedLog(entry, _original(entry), status.st_size, _deleted(entry)))
        return sorted(found, key=lambda log: (-log.deleted, log.name))

    def restore(self, name: str) -> Path:
        """Take a log (by its name in `bin()`) out of the recycle bin and return its path.

        Raises
        ------
        StoreError
            If it is not there, a log of its name has been made meanwhile, or the disk refuses.
        """
        with self._lock:
            target = self._folder / _original(name)
            _move(self._in_bin(name), target)
            return target

    def purge(self, name: str | None = None) -> None:
        """Remove one log of the recycle bin, or all, for good.

        Raises
        ------
        StoreError
            If there is no such log in the recycle bin, or the disk refuses.
        """
        with self._lock:
            for each in [log.name for log in self.bin()] if name is None else [name]:
                binned = self._bin / each if name is None else self._in_bin(each)
                try:
                    binned.unlink(missing_ok=True)
                except OSError as error:
                    raise _refusal(each, error) from None

    def _make_bin(self) -> None:
        if self._bin.is_symlink():
            raise StoreError(f"{self._bin}: is a link; remove it, a recycle bin is made instead")
        try:
            self._bin.mkdir(exist_ok=True)
        except OSError as error:
            raise _refusal(BIN, error) from None

    def _in_bin(self, name: str) -> Path:
        _original(name)
        return _within(self._bin, name)

    def _look(self, name: str, status: os.stat_result) -> StoredLog:
        """Return what there is to tell of a log; a look inside is taken once for each version."""
        path, version = self._folder / name, (status.st_size, status.st_mtime_ns)
        recording = is_being_written(path)
        cut, duration = False, math.nan
        if not recording:
            known = self._known.get(name)
            if known is None or known[0] != version:
                known = self._known[name] = version, *_end_of(path)
            _, cut, duration = known
        return StoredLog(name, status.st_size, status.st_mtime, recording, cut, duration)


def _is_name(name: str) -> bool:
    """Tell whether a name can be that of a log: one file's, visible, and printable."""
    return (
        name.endswith(".mcap")
        and not name.startswith(".")
        and name.isprintable()
        and not set(name) & {"/", "\\", os.sep}
    )


def _files(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """Yield names and status of the logs in a folder that is none elsewhere; links are left out."""
    if folder.name == BIN and folder.is_symlink():
        return
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):  # it has vanished meanwhile
                if _is_name(entry.name) and entry.is_file(follow_symlinks=False):
                    yield entry.name, entry.stat(follow_symlinks=False)


def _within(folder: Path, name: str) -> Path:
    """Return the path of a log that is a plain file in this very folder."""
    if not _is_name(name) or (folder.name == BIN and folder.is_symlink()):
        raise _unknown(name)
    path = folder / name
    try:
        if stat.S_ISREG(path.lstat().st_mode):
            return path
    except OSError:  # it is not there, or its name is too long
        pass
    raise _unknown(name)


def _original(binned: str) -> str:
    """Return the name that a log in the recycle bin had."""
    match = _BINNED.fullmatch(binned)
    if match is None:
        raise _unknown(binned)
    return match[1]


def _deleted(binned: str) -> float:
    """Return when a log was put in the recycle bin; `ValueError` if its name has no such date."""
    return datetime.strptime(binned[:16], _STAMP).replace(tzinfo=UTC).timestamp()


def _unknown(name: str) -> StoreError:
    return StoreError(f"{name[:100]!r}: there is no such log; choose one of the list")


def _refusal(name: str, error: OSError) -> StoreError:
    if isinstance(error, FileNotFoundError):  # it has vanished meanwhile
        return _unknown(name)
    return StoreError(f"{name}: the disk refuses ({error.strerror}); check it and its permissions")


def _move(source: Path, target: Path) -> None:
    """Rename a file; never onto another one, which renaming alone would overwrite."""
    try:
        target.open("xb").close()
    except FileExistsError:
        raise StoreError(f"{target.name}: there is such a log already; delete it first") from None
    except OSError as error:
        raise _refusal(target.name, error) from None
    try:
        source.replace(target)
    except OSError as error:
        target.unlink(missing_ok=True)
        raise _refusal(source.name, error) from None


def _end_of(path: Path) -> tuple[bool, float]:
    """Return whether a log lacks its end, and the s from its first message to its last, or NaN."""
    try:
        with path.open("rb") as file:
            file.seek(-len(_MAGIC), os.SEEK_END)
            if file.read() != _MAGIC:
                return True, math.nan
    except OSError:  # empty, or it has vanished
        return True, math.nan
    reader = McapReader(path)
    try:
        reader.open()
    except Exception:  # rosbags raises anything on a damaged summary
        return False, math.nan
    duration = reader.metadata.duration / 1e9
    reader.close()
    return False, duration
