"""One recording: the thread that takes readings from the queue and sees them to the disk."""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from impslam.errors import ImpError, MessageError
from impslam.platform.devices.base import Reading, now
from impslam.platform.station.recorder_queue import ReadingQueue
from impslam.sources.live_recording import LiveMcapWriter
from impslam.sources.ros_build import topic_name
from impslam.types import DeviceTime, Event, Message

log = logging.getLogger(__name__)

PERIOD = 0.4  # s between syncs: with the time that writing takes, a kill costs less than 1 s

FIXES = {
    errno.ENOSPC: "delete logs and empty the recycle bin",
    errno.EDQUOT: "delete logs and empty the recycle bin",
    errno.EROFS: "check the file system",
    errno.EIO: "save its logs and replace the disk",
    errno.EACCES: "check its permissions",
    errno.EPERM: "check its permissions",
}


class RecordingError(ImpError):
    """A recording that cannot start, or ended by itself: what, where, what to do."""


def disk_error(path: Path, error: OSError) -> RecordingError:
    """Return what an error of the disk means for a log."""
    fix = FIXES.get(error.errno or 0, "check the disk")
    return RecordingError(f"{path}: cannot be written ({error.strerror or error}); {fix}")


class Recording:
    """Writes one log until it is stopped, or the disk ends it.

    Parameters
    ----------
    path, preset : as `LiveMcapWriter` has them
    room : called for the bytes that may still be written
    tell : called with (level, text), from the thread, for what everyone should know

    Raises
    ------
    OSError, SourceError
        If the log cannot be begun.
    """

    def __init__(
        self, path: Path, preset: str, room: Callable[[], int], tell: Callable[[str, str], None]
    ) -> None:
        self.path, self.error = path, ""
        self._room, self._tell = room, tell
        self._began, self._ended = now(), float("nan")
        self._queue = ReadingQueue()
        self._written: Counter[str] = Counter()
        self._unsynced: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._lost, self._losing = 0, False  # dropped so far, and whether that goes on
        self._first: dict[type[Message], str] = {}  # the first device that sent a type
        self._stopping = threading.Event()
        self._log = ExitStack()
        self._writer = self._log.enter_context(LiveMcapWriter(path, preset, self._began))
        self.size = self._writer.size
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, reading: Reading) -> None:
        """Take a reading without waiting."""
        self._queue.put(reading)

    def stop(self, wait: float) -> None:
        """Write what has been put and close the log; a slow disk may take longer than `wait` s."""
        self._queue.close()
        self._stopping.set()
        self._thread.join(wait)

    @property
    def active(self) -> bool:
        """Whether the log is still being written."""
        return self._thread.is_alive()

    @property
    def seconds(self) -> float:
        """How long it has been, or was, recording."""
        return (now() if self.active else self._ended) - self._began

    @property
    def waiting(self) -> int:
        """Readings not yet written."""
        return len(self._queue)

    def written(self) -> dict[str, int]:
        """Return the number of messages in the log, by type."""
        return dict(self._written)

    def dropped(self) -> dict[str, int]:
        """Return the number of messages that are not in the log, by type."""
        return dict(self._queue.dropped() + self._refused.copy())

    def _run(self) -> None:
        try:
            with self._log:
                self._keep_writing()
            self.size = self.path.stat().st_size
        except OSError as error:
            self.error = str(disk_error(self.path, error))
        except RecordingError as error:
            self.error = str(error)
        except Exception as error:  # a fault of ours must not take the robot down
            log.exception("recorder")
            self.error = f"{self.path}: {type(error).__name__}: {error}; please report it"
        self._queue.close()
        self._refused.update(self._unsynced)  # an error left them behind
        self._refused.update(type(reading.message).__name__ for reading in self._queue.take())
        self._ended = now()
        if self.error:
            self._tell("error", f"recording has ended: {self.error}")
        else:
            self._tell("info", f"{self.path.name}: recorded {self.seconds:.0f} s")

    def _keep_writing(self) -> None:
        due = time.monotonic()
        while not self._stopping.is_set():
            due = max(due + PERIOD, time.monotonic())
            self._stopping.wait(due - time.monotonic())
            if not self._writer.in_place:  # before more is written behind what was cut off
                raise RecordingError(f"{self.path}: was moved, deleted or cut while it was written")
            self._write_waiting()
            if self._room() <= 0:
                self.error = (
                    f"{self.path}: the disk is full up to its reserve; " + FIXES[errno.ENOSPC]
                )
                return
        self._write_waiting()  # what came before the queue was closed

    def _write_waiting(self) -> None:
        for reading in self._queue.take():
            self._write(reading)
        self._writer.sync()
        self._written.update(self._unsynced)
        self._unsynced.clear()
        self.size = self._writer.size
        self._tell_losses()

    def _write(self, reading: Reading) -> None:
        message, kind = reading.message, type(reading.message).__name__
        try:
            self._writer.write(message, reading.arrived, self._below(reading))
        except OSError:
            raise
        except Exception as error:  # one bad message does not end a recording
            if not isinstance(error, MessageError):
                log.exception("recorder: %s", reading.device)
            self._refused[kind] += 1
            if self._refused[kind] == 1:
                self._tell("warning", f"{reading.device}: {kind} cannot be recorded: {error}")
        else:
            self._unsynced[kind] += 1

    def _below(self, reading: Reading) -> str:
        """Return what sets the topic of a second lidar, camera, ... apart from the first one's."""
        if isinstance(reading.message, Event | DeviceTime):  # say themselves what they are about
            return ""
        first = self._first.setdefault(type(reading.message), reading.device)
        return "" if first == reading.device else f"/{topic_name(reading.device)}"

    def _tell_losses(self) -> None:
        """Tell when the queue begins to drop, and the numbers once it has recovered."""
        dropped = self._queue.dropped()
        before, self._lost = self._lost, dropped.total()
        losing, self._losing = self._losing, self._lost > before
        if self._losing and not losing:
            self._tell("warning", f"{self.path.name}: the disk is too slow; readings are dropped")
        elif losing and not self._losing:
            counts = ", ".join(f"{count} {kind}" for kind, count in sorted(dropped.items()))
            self._tell("warning", f"{self.path.name}: dropped so far: {counts}")
