"""The recorder: everything the devices say, on one time base, into an MCAP that survives its end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from impslam.devices.base import Reading
from impslam.errors import ImpError


class RecordingError(ImpError):
    """A recording that cannot start, or ended by itself: what, where, what to do."""


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """How the recording is doing.

    Attributes
    ----------
    active : whether a log is being written
    path : the log being written, or the last one; None before the first
    seconds : how long it has been (had been) recording
    size : bytes written so far
    free : bytes free on the disk beside the floor: 0 means that recording is impossible
    written, dropped : messages by type, of this log
    error : why the last recording ended by itself or could not start, "" if it did neither
    """

    active: bool = False
    path: Path | None = None
    seconds: float = 0.0
    size: int = 0
    free: int = 0
    written: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    error: str = ""


class LogRecorder:
    """Writes readings into a log in a thread of its own.

    Parameters
    ----------
    folder : where logs are kept; made if it is missing
    preset : name of the robot's preset, written first, so that `imp run LOG` chooses it
    floor : bytes that stay free on the disk
    """

    def __init__(self, folder: Path, preset: str, floor: int) -> None:
        self._folder, self._preset, self._floor = Path(folder), preset, floor

    def start(self, name: str | None = None) -> Path:
        """Begin a log `<date>-<time>[-name].mcap` and return its path.

        Raises
        ------
        RecordingError
            If a log is being written already, the disk has no room above the floor, or the folder
            cannot be written.
        """
        raise NotImplementedError

    def stop(self) -> Path | None:
        """Write what waits, close the log and return its path; None if none was being written."""
        raise NotImplementedError

    def put(self, reading: Reading) -> None:
        """Take a reading, from any thread, without waiting; nothing happens while not recording."""
        raise NotImplementedError

    def status(self) -> RecordingStatus:
        """Return how the recording is doing."""
        raise NotImplementedError
