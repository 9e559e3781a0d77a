"""The recorder: everything the devices say, on one time base, into an MCAP that survives its end."""

from __future__ import annotations

import math
import re
import shutil
import threading
import time
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from impslam.errors import ImpError
from impslam.paths import numbered
from impslam.platform.devices.base import Reading
from impslam.platform.station.recorder_thread import Recording, RecordingError, disk_error
from impslam.sources.live_recording import LogExistsError

LONGEST_NAME = 60  # letters; file systems allow 255 bytes with date, number and suffix
FRESH = 1.0  # s between looks at how much of the disk is free
PATIENCE = 30.0  # s that stopping waits for a slow disk


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
    written : messages by type that are safe on the disk
    dropped : messages by type that are not in this log: refused, too many for a slow disk, or left
        behind by one that failed
    error : why the last recording ended by itself or could not start, "" if it did neither
    waiting : readings that are not yet written; many where the disk is slow
    """

    active: bool = False
    path: Path | None = None
    seconds: float = 0.0
    size: int = 0
    free: int = 0
    written: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    error: str = ""
    waiting: int = 0


class Sampled:
    """A number that may take long to find out (a disk may hang), looked up in a thread of its own."""

    def __init__(self, measure: Callable[[], int]) -> None:
        self._measure, self._lock = measure, threading.Lock()
        self._value, self._due = 0, float("-inf")

    def lately(self) -> int:
        """Return it as it was a second or two ago; never waits, but for the first time."""
        first = math.isinf(self._due)
        if time.monotonic() > self._due and self._lock.acquire(blocking=False):
            self._due = time.monotonic() + FRESH
            thread = threading.Thread(target=self._look, name="disk", daemon=True)
            thread.start()
            if first:
                thread.join(FRESH)
        return self._value

    def _look(self) -> None:
        try:
            self._value = self._measure()
        finally:
            self._lock.release()


class LogRecorder:
    """Writes readings into a log, in a thread of its own.

    What has been put is on the disk half a second later and survives a kill or a power loss. A
    disk that fails or fills up ends the recording, tells why, and leaves a log that can be read.

    Parameters
    ----------
    folder : where logs are kept; made if it is missing
    preset : name of the robot's preset, or its config as TOML; written first, and `imp run LOG` takes it
    floor : bytes that stay free on the disk
    tell : called with (level, text), from any thread, for what everyone should know
    """

    def __init__(
        self, folder: Path, preset: str, floor: int, tell: Callable[[str, str], None]
    ) -> None:
        self._folder, self._preset, self._floor = Path(folder), preset, floor
        self._tell = tell
        self._free = Sampled(self._room)
        self._gate = threading.Lock()  # of starting and stopping; a reading never waits for it
        self._recording: Recording | None = None
        self._refusal = ""

    def start(self, name: str | None = None) -> Path:
        """Begin a log `<date>-<time>[-name].mcap` and return its path.

        Raises
        ------
        RecordingError
            If a log is being written already, the disk has no room above the floor, or the folder
            cannot be written.
        """
        with self._gate:
            if self._recording is not None and self._recording.active:
                raise RecordingError(f"{self._recording.path}: is being recorded; stop it first")
            try:
                self._recording = self._begin(name)
            except ImpError as error:
                self._refusal = str(error)
                raise
            self._refusal = ""
        self._tell("info", f"recording {self._recording.path.name}")
        return self._recording.path

    def stop(self) -> Path | None:
        """Write what waits, close the log and return its path; None if none was being written.

        Waits for the disk, up to `PATIENCE`: not to be called where nothing may wait.
        """
        with self._gate:
            recording = self._recording
            if recording is None or not recording.active:
                return None
            recording.stop(PATIENCE)
            return recording.path

    def put(self, reading: Reading) -> None:
        """Take a reading, from any thread, without waiting; nothing happens while not recording."""
        recording = self._recording
        if recording is not None:
            recording.put(reading)

    def status(self) -> RecordingStatus:
        """Return how the recording is doing."""
        last = self._recording
        if last is None:
            return RecordingStatus(free=self._free.lately(), error=self._refusal)
        return RecordingStatus(
            active=last.active,
            path=last.path,
            seconds=last.seconds,
            size=last.size,
            free=self._free.lately(),
            written=last.written(),
            dropped=last.dropped(),
            error=self._refusal or last.error,
            waiting=last.waiting,
        )

    def _begin(self, name: str | None) -> Recording:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            if self._room() <= 0:
                raise RecordingError(
                    f"{self._folder}: less than the reserve of {self._floor / 1e6:.0f} MB is free "
                    "on the disk; delete logs and empty the recycle bin"
                )
            for path in self._paths(name):
                with suppress(LogExistsError):  # another recorder of this folder was as fast
                    return Recording(path, self._preset, self._room, self._tell)
            raise AssertionError("names never end")
        except OSError as error:
            raise disk_error(self._folder, error) from None

    def _paths(self, name: str | None) -> Iterator[Path]:
        stem = time.strftime("%Y%m%d-%H%M%S")
        stem += f"-{said}" if (said := file_name(name or "")) else ""
        return numbered(self._folder, stem, ".mcap")

    def _room(self) -> int:
        """Return the bytes that may still be written; 0 if the folder cannot be asked."""
        folder = self._folder.absolute()
        try:
            while not folder.exists():
                folder = folder.parent
            return max(0, shutil.disk_usage(folder).free - self._floor)
        except OSError:
            return 0


def file_name(text: str) -> str:
    """Return a text as part of a file name: ASCII letters, digits, ., _ and - alone."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", plain.strip().removesuffix(".mcap"))
    return re.sub(r"\.{2,}", ".", name)[:LONGEST_NAME].strip(".-_")
