"""The logs on the robot's disk, and a recycle bin for deleted ones."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from rosbags.rosbag2.storage_mcap import McapReader

from impslam.platform.station.store import LOGS, Store, StoreError
from impslam.sources.live_recording import is_being_written
from impslam.sources.mcap_reader import MAGIC


@dataclass(frozen=True, slots=True)
class StoredLog:
    """A log on the disk.

    Attributes
    ----------
    name : file name
    size : bytes
    modified : s since 1970, when it was last written
    recording : whether it is being written
    cut : whether its end is missing (power loss); `imp run` reads it up to there
    duration : s from the first message to the last, NaN if only reading all of it would give it
    """

    name: str
    size: int
    modified: float
    recording: bool
    cut: bool
    duration: float


class LogStore(Store):
    """The logs in a folder; every method may be called from any thread.

    Only `.mcap` files directly in the folder count: no links, no other folders.

    Parameters
    ----------
    folder : where logs are kept; it may be missing, and files may vanish at any time
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(Path(folder), LOGS)
        self._cache: dict[str, tuple[tuple[int, int], bool, float]] = {}

    def logs(self) -> list[StoredLog]:
        """Return the logs, newest first."""
        found = [self._describe(name, status) for name, status in self.entries()]
        return sorted(found, key=lambda log: (-log.modified, log.name))

    def delete(self, name: str) -> None:
        """Move a log to the recycle bin.

        Raises
        ------
        StoreError
            If there is no such log, it is being recorded, or the disk refuses.
        """
        if is_being_written(self.path(name)):
            raise StoreError(f"{name}: is being recorded; stop the recording before deleting it")
        self.discard(name)

    def _describe(self, name: str, status: os.stat_result) -> StoredLog:
        """Return the description of a log; the file is read once per version."""
        path, version = self.folder / name, (status.st_size, status.st_mtime_ns)
        recording = is_being_written(path)
        cut, duration = False, math.nan
        if not recording:
            cached = self._cache.get(name)
            if cached is None or cached[0] != version:
                cached = self._cache[name] = version, *_end_of(path)
            _, cut, duration = cached
        return StoredLog(name, status.st_size, status.st_mtime, recording, cut, duration)


def _end_of(path: Path) -> tuple[bool, float]:
    """Return whether the end of a log is missing, and its duration in s, or NaN."""
    try:
        with path.open("rb") as file:
            file.seek(-len(MAGIC), os.SEEK_END)
            if file.read() != MAGIC:
                return True, math.nan
    except OSError:  # empty, or vanished
        return True, math.nan
    reader = McapReader(path)
    try:
        reader.open()
    except Exception:  # rosbags raises errors of many types on a damaged summary
        return False, math.nan
    duration = reader.metadata.duration / 1e9
    reader.close()
    return False, duration
