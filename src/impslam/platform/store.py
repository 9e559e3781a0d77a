"""The logs on the robot's disk: what there is, and a recycle bin before anything is gone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from impslam.errors import ImpError


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

    Parameters
    ----------
    folder : where logs are kept; it may be missing, and files may vanish at any time
    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)

    def logs(self) -> list[StoredLog]:
        """Return the logs, newest first."""
        raise NotImplementedError

    def path(self, name: str) -> Path:
        """Return the path of a log by its name in `logs()`; nothing else is ever returned.

        Raises
        ------
        StoreError
            If there is no such log in the folder.
        """
        raise NotImplementedError

    def delete(self, name: str) -> None:
        """Move a log to the recycle bin.

        Raises
        ------
        StoreError
            If there is no such log, or it is being recorded.
        """
        raise NotImplementedError

    def bin(self) -> list[BinnedLog]:
        """Return what is in the recycle bin, last deleted first."""
        raise NotImplementedError

    def restore(self, name: str) -> Path:
        """Take a log (by its name in `bin()`) out of the recycle bin and return its path.

        Raises
        ------
        StoreError
            If it is not there, or a log of its name has been made meanwhile.
        """
        raise NotImplementedError

    def purge(self, name: str | None = None) -> None:
        """Remove one log of the recycle bin, or all, for good.

        Raises
        ------
        StoreError
            If there is no such log in the recycle bin.
        """
        raise NotImplementedError
