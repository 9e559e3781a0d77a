"""The logs on the robot's disk: what there is, and a recycle bin before anything is gone."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from rosbags.rosbag2.storage_mcap import McapReader

from impslam.platform.station.shelf import LOGS, Shelf, StoreError
from impslam.sources.live_recording import is_being_written

_MAGIC = b"\x89MCAP0\r\n"


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


class LogStore(Shelf):
    """The logs in a folder; every method may be called from any thread.

    Only `.mcap` files that lie in the folder itself exist here: no links, no other folders.

    Parameters
    ----------
    folder : where logs are kept; it may be missing, and files may vanish at any time
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(Path(folder), LOGS)
        self._known: dict[str, tuple[tuple[int, int], bool, float]] = {}

    def logs(self) -> list[StoredLog]:
        """Return the logs, newest first."""
        found = [self._look(name, status) for name, status in self.entries()]
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

    def _look(self, name: str, status: os.stat_result) -> StoredLog:
        """Return what there is to tell of a log; a look inside is taken once for each version."""
        path, version = self.folder / name, (status.st_size, status.st_mtime_ns)
        recording = is_being_written(path)
        cut, duration = False, math.nan
        if not recording:
            known = self._known.get(name)
            if known is None or known[0] != version:
                known = self._known[name] = version, *_end_of(path)
            _, cut, duration = known
        return StoredLog(name, status.st_size, status.st_mtime, recording, cut, duration)


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
