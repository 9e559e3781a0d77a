"""The recorder: writes all device readings, on one time base, to an MCAP that survives a crash."""

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
from impslam.platform.station.topics import TopicNames
from impslam.sources.live_recording import LogExistsError

MAX_NAME_LENGTH = 60  # characters; file systems allow 255 bytes with date, number and suffix
SAMPLE_INTERVAL = 1.0  # s between queries of the free disk space
STOP_TIMEOUT = 30.0  # s that stopping waits for a slow disk


@dataclass(frozen=True, slots=True)
class RecordingStatus:
    """The status of the recording.

    Attributes
    ----------
    active : whether a log is being written
    path : the log being written, or the last one; None before the first
    seconds : duration of the recording
    size : bytes written so far
    free : bytes free on the disk above the floor; 0 means that recording is impossible
    written : messages by type that are safe on the disk
    dropped : messages by type that are not in this log: invalid, too many for a slow disk, or not
        written before the disk failed
    error : why the last recording ended by itself or could not start, "" otherwise
    waiting : readings not yet written; many if the disk is slow
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
    """A number that may be slow to measure (a disk may hang), sampled in a thread of its own."""

    def __init__(self, measure: Callable[[], int]) -> None:
        self._measure, self._lock = measure, threading.Lock()
        self._value, self._due = 0, float("-inf")

    def latest(self) -> int:
        """Return the latest sample, a second or two old; waits only at the first call."""
        first = math.isinf(self._due)
        if time.monotonic() > self._due and self._lock.acquire(blocking=False):
            self._due = time.monotonic() + SAMPLE_INTERVAL
            thread = threading.Thread(target=self._sample, name="disk", daemon=True)
            thread.start()
            if first:
                thread.join(SAMPLE_INTERVAL)
        return self._value

    def _sample(self) -> None:
        try:
            self._value = self._measure()
        finally:
            self._lock.release()


class LogRecorder:
    """Writes readings to a log in its own thread.

    A reading is on the disk half a second later and survives a kill or a power loss. A disk that
    fails or fills up ends the recording with a notice and leaves a readable log.

    Parameters
    ----------
    folder : where logs are kept; created if it is missing
    preset : name of the robot's preset, or its config as TOML; written first, used by `imp run LOG`
    floor : bytes that stay free on the disk
    notify : called with (level, text), from any thread, for events that everyone should see
    topics : names the topics of readings
    """

    def __init__(
        self,
        folder: Path,
        preset: str,
        floor: int,
        notify: Callable[[str, str], None],
        topics: TopicNames | None = None,
    ) -> None:
        self._folder, self._preset, self._floor = Path(folder), preset, floor
        self._notify, self._topics = notify, topics or TopicNames()
        self._free = Sampled(self._free_above_floor)
        self._start_stop = threading.Lock()  # of `start` and `stop`; `put` never waits for it
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
        with self._start_stop:
            if self._recording is not None and self._recording.active:
                raise RecordingError(f"{self._recording.path}: is being recorded; stop it first")
            try:
                self._recording = self._begin(name)
            except ImpError as error:
                self._refusal = str(error)
                raise
            self._refusal = ""
        self._notify("info", f"recording {self._recording.path.name}")
        return self._recording.path

    def stop(self) -> Path | None:
        """Write waiting readings, close the log and return its path, or None without a recording.

        Blocks until the disk is done, for at most `STOP_TIMEOUT`.
        """
        with self._start_stop:
            recording = self._recording
            if recording is None or not recording.active:
                return None
            recording.stop(STOP_TIMEOUT)
            return recording.path

    def put(self, reading: Reading) -> None:
        """Add a reading, from any thread, without blocking; do nothing unless recording."""
        recording = self._recording
        if recording is not None:
            recording.put(reading)

    def status(self) -> RecordingStatus:
        """Return the status of the recording."""
        last = self._recording
        if last is None:
            return RecordingStatus(free=self._free.latest(), error=self._refusal)
        return RecordingStatus(
            active=last.active,
            path=last.path,
            seconds=last.seconds,
            size=last.size,
            free=self._free.latest(),
            written=last.written(),
            dropped=last.dropped(),
            error=self._refusal or last.error,
            waiting=last.waiting,
        )

    def _begin(self, name: str | None) -> Recording:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            if self._free_above_floor() <= 0:
                raise RecordingError(
                    f"{self._folder}: less than the reserve of {self._floor / 1e6:.0f} MB is free "
                    "on the disk; delete logs and empty the recycle bin"
                )
            for path in self._paths(name):
                with suppress(LogExistsError):  # another recorder has just taken this name
                    free, topics = self._free_above_floor, self._topics
                    return Recording(path, self._preset, free, self._notify, topics)
            raise AssertionError("names never end")
        except OSError as error:
            raise disk_error(self._folder, error) from None

    def _paths(self, name: str | None) -> Iterator[Path]:
        stem = time.strftime("%Y%m%d-%H%M%S")
        stem += f"-{label}" if (label := file_name(name or "")) else ""
        return numbered(self._folder, stem, ".mcap")

    def _free_above_floor(self) -> int:
        """Return the bytes that may still be written; 0 if the folder cannot be queried."""
        folder = self._folder.absolute()
        try:
            while not folder.exists():
                folder = folder.parent
            return max(0, shutil.disk_usage(folder).free - self._floor)
        except OSError:
            return 0


def file_name(text: str) -> str:
    """Return a text as part of a file name: only ASCII letters, digits, ., _ and -."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", plain.strip().removesuffix(".mcap"))
    return re.sub(r"\.{2,}", ".", name)[:MAX_NAME_LENGTH].strip(".-_")
