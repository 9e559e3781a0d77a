"""Files or folders of one kind on the robot's disk, by name, with a recycle bin."""

from __future__ import annotations

import os
import re
import shutil
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from impslam.errors import ImpError

BIN = ".bin"
_BINNED = re.compile(r"[0-9]{8}T[0-9]{6}Z(?:-[0-9]+)?_(.+)")  # when deleted, what it was
_STAMP = "%Y%m%dT%H%M%SZ"


class StoreError(ImpError):
    """An entry that is missing or must not be changed; the message says what to do."""


@dataclass(frozen=True, slots=True)
class DeletedEntry:
    """An entry of a recycle bin: `name` there, original name, bytes, s since 1970 when deleted."""

    name: str
    original: str
    size: int
    deleted: float


@dataclass(frozen=True, slots=True)
class EntryKind:
    """A kind of entries: their word, the suffix of their names, and a test of the file mode."""

    word: str
    suffix: str
    fits: Callable[[int], bool]


LOGS = EntryKind("log", ".mcap", stat.S_ISREG)
MAPS = EntryKind("map", "", stat.S_ISDIR)


class Store:
    """The entries of one kind in a folder; every method may be called from any thread.

    Only entries directly in the folder count: no links, no other folders.

    Parameters
    ----------
    folder : it may be missing, and entries may vanish at any time
    """

    def __init__(self, folder: Path, kind: EntryKind) -> None:
        self.folder, self._kind = folder, kind
        self._bin = folder / BIN
        self._lock = threading.Lock()  # of moves

    def entries(self) -> Iterator[tuple[str, os.stat_result]]:
        """Yield names and status."""
        return self._entries_in(self.folder)

    def path(self, name: str) -> Path:
        """Return the path of an entry.

        Raises
        ------
        StoreError
            If there is no such entry in the folder.
        """
        return self._path(self.folder, name)

    def discard(self, name: str) -> None:
        """Move an entry to the recycle bin.

        Raises
        ------
        StoreError
            If there is no such entry, or the disk refuses.
        """
        with self._lock:
            path = self.path(name)
            self._make_bin()
            stamp = datetime.now(UTC).strftime(_STAMP)
            target, number = self._bin / f"{stamp}_{name}", 1
            while target.exists():
                number += 1
                target = self._bin / f"{stamp}-{number}_{name}"
            self._move(path, target)

    def bin(self) -> list[DeletedEntry]:
        """Return the contents of the recycle bin, last deleted first."""
        found = []
        for entry, status in self._entries_in(self._bin):
            with suppress(StoreError, ValueError, OSError):  # not put there by this class, or gone
                size = status.st_size if stat.S_ISREG(status.st_mode) else _size(self._bin / entry)
                found.append(DeletedEntry(entry, self._original(entry), size, _deleted(entry)))
        return sorted(found, key=lambda binned: (-binned.deleted, binned.name))

    def restore(self, name: str) -> Path:
        """Move an entry (by its name in `bin()`) back from the recycle bin and return its path.

        Raises
        ------
        StoreError
            If it is not there, its original name is taken, or the disk refuses.
        """
        with self._lock:
            target = self.folder / self._original(name)
            self._move(self._path(self._bin, name), target)
            return target

    def purge(self) -> None:
        """Delete all entries of the recycle bin permanently.

        Raises
        ------
        StoreError
            If the disk refuses.
        """
        with self._lock:
            for binned in self.bin():
                try:
                    _remove(self._bin / binned.name)
                except OSError as error:
                    raise self._refusal(binned.name, error) from None

    def _make_bin(self) -> None:
        if self._bin.is_symlink():
            raise StoreError(f"{self._bin}: is a link; remove it, and a recycle bin is created")
        try:
            self._bin.mkdir(exist_ok=True)
        except OSError as error:
            raise self._refusal(BIN, error) from None

    def _is_name(self, name: str) -> bool:
        """Return whether a name is valid for an entry: a single name, not hidden, printable."""
        return (
            name.endswith(self._kind.suffix)
            and name not in {"", ".", ".."}
            and not name.startswith(".")
            and name.isprintable()
            and not set(name) & {"/", "\\", os.sep}
        )

    def _entries_in(self, folder: Path) -> Iterator[tuple[str, os.stat_result]]:
        """Yield names and status in a folder, without links; nothing if the bin is a link."""
        if folder.name == BIN and folder.is_symlink():
            return
        with suppress(OSError), os.scandir(folder) as entries:
            for entry in entries:
                with suppress(OSError):  # it has vanished meanwhile
                    status = entry.stat(follow_symlinks=False)
                    if self._is_name(entry.name) and self._kind.fits(status.st_mode):
                        yield entry.name, status

    def _path(self, folder: Path, name: str) -> Path:
        """Return the path of an entry directly in a folder."""
        if not self._is_name(name) or (folder.name == BIN and folder.is_symlink()):
            raise self._unknown(name)
        path = folder / name
        try:
            if self._kind.fits(path.lstat().st_mode):
                return path
        except OSError:  # missing, or its name is too long
            pass
        raise self._unknown(name)

    def _original(self, binned: str) -> str:
        """Return the original name of an entry of the recycle bin."""
        match = _BINNED.fullmatch(binned)
        if match is None or not self._is_name(match[1]):
            raise self._unknown(binned)
        return match[1]

    def _move(self, source: Path, target: Path) -> None:
        """Rename, but never onto an existing entry, which `rename` alone would overwrite."""
        try:
            if source.is_dir():
                target.mkdir()
            else:
                target.open("xb").close()
        except FileExistsError:
            raise StoreError(
                f"{target.name}: a {self._kind.word} of this name exists; delete it first"
            ) from None
        except OSError as error:
            raise self._refusal(target.name, error) from None
        try:
            source.replace(target)
        except OSError as error:
            with suppress(OSError):
                _remove(target)
            raise self._refusal(source.name, error) from None

    def _unknown(self, name: str) -> StoreError:
        word = self._kind.word
        return StoreError(f"{name[:100]!r}: there is no such {word}; choose one of the list")

    def _refusal(self, name: str, error: OSError) -> StoreError:
        if isinstance(error, FileNotFoundError):  # vanished meanwhile
            return self._unknown(name)
        return StoreError(
            f"{name}: the disk refuses ({error.strerror}); check it and its permissions"
        )


def _deleted(binned: str) -> float:
    """Return when an entry was deleted, s since 1970; `ValueError` if its name has no date."""
    return datetime.strptime(binned[:16], _STAMP).replace(tzinfo=UTC).timestamp()


def _size(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.iterdir())


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
