"""One recording: the thread that writes readings from the queue to the disk."""

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
from impslam.platform.station.topics import TopicNames
from impslam.sources.live_recording import LiveMcapWriter

log = logging.getLogger(__name__)

SYNC_INTERVAL = 0.4  # s between syncs: with the time of writing, a kill costs less than 1 s

FIXES = {
    errno.ENOSPC: "delete logs and empty the recycle bin",
    errno.EDQUOT: "delete logs and empty the recycle bin",
    errno.EROFS: "check the file system",
    errno.EIO: "save its logs and replace the disk",
    errno.EACCES: "check its permissions",
    errno.EPERM: "check its permissions",
}


class RecordingError(ImpError):
    """A recording that cannot start, or ended by itself; the message says what to do."""


def disk_error(path: Path, error: OSError) -> RecordingError:
    """Return the recording error for an error of the disk."""
    fix = FIXES.get(error.errno or 0, "check the disk")
    return RecordingError(f"{path}: cannot be written ({error.strerror or error}); {fix}")


class Recording:
    """Writes one log until it is stopped or the disk fails.

    Parameters
    ----------
    path, preset : as of `LiveMcapWriter`
    free_bytes : returns the bytes that may still be written
    notify : called with (level, text), from the thread, for events that everyone should see
    topics : names the topics of readings

    Raises
    ------
    OSError, SourceError
        If the log cannot be created.
    """

    def __init__(
        self,
        path: Path,
        preset: str,
        free_bytes: Callable[[], int],
        notify: Callable[[str, str], None],
        topics: TopicNames,
    ) -> None:
        self.path, self.error, self._topics = path, "", topics
        self._free_bytes, self._notify = free_bytes, notify
        self._started_at, self._ended_at = now(), float("nan")
        self._queue = ReadingQueue()
        self._written: Counter[str] = Counter()
        self._unsynced: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._dropped, self._dropping = 0, False  # count, and whether it grew at the last sync
        self._stopping = threading.Event()
        self._log = ExitStack()
        self._writer = self._log.enter_context(LiveMcapWriter(path, preset, self._started_at))
        self.size = self._writer.size
        self._thread = threading.Thread(target=self._run_thread, name="recorder", daemon=True)
        self._thread.start()

    def put(self, reading: Reading) -> None:
        """Add a reading without blocking."""
        self._queue.put(reading)

    def stop(self, wait: float) -> None:
        """Write waiting readings and close the log; return after `wait` s even if the disk is slower."""
        self._queue.close()
        self._stopping.set()
        self._thread.join(wait)

    @property
    def active(self) -> bool:
        """Whether the log is still being written."""
        return self._thread.is_alive()

    @property
    def seconds(self) -> float:
        """Duration of the recording, s."""
        return (now() if self.active else self._ended_at) - self._started_at

    @property
    def waiting(self) -> int:
        """Number of readings not yet written."""
        return len(self._queue)

    def written(self) -> dict[str, int]:
        """Return the number of messages in the log, by type."""
        return dict(self._written)

    def dropped(self) -> dict[str, int]:
        """Return the number of messages that are not in the log, by type."""
        return dict(self._queue.dropped() + self._refused.copy())

    def _run_thread(self) -> None:
        try:
            with self._log:
                self._keep_writing()
            self.size = self.path.stat().st_size
        except OSError as error:
            self.error = str(disk_error(self.path, error))
        except RecordingError as error:
            self.error = str(error)
        except Exception as error:  # a bug here must not stop the robot
            log.exception("recorder")
            self.error = f"{self.path}: {type(error).__name__}: {error}; please report it"
        self._queue.close()
        self._refused.update(self._unsynced)  # not written before the error
        self._refused.update(type(reading.message).__name__ for reading in self._queue.take())
        self._ended_at = now()
        if self.error:
            self._notify("error", f"recording has ended: {self.error}")
        else:
            self._notify("info", f"{self.path.name}: recorded {self.seconds:.0f} s")

    def _keep_writing(self) -> None:
        due = time.monotonic()
        while not self._stopping.is_set():
            due = max(due + SYNC_INTERVAL, time.monotonic())
            self._stopping.wait(due - time.monotonic())
            if not self._writer.in_place:  # do not write behind a cut
                raise RecordingError(f"{self.path}: was moved, deleted or cut while it was written")
            self._write_waiting()
            if self._free_bytes() <= 0:
                self.error = (
                    f"{self.path}: the disk is full up to its reserve; " + FIXES[errno.ENOSPC]
                )
                return
        self._write_waiting()  # put before the queue was closed

    def _write_waiting(self) -> None:
        for reading in self._queue.take():
            self._write(reading)
        self._writer.sync()
        self._written.update(self._unsynced)
        self._unsynced.clear()
        self.size = self._writer.size
        self._report_drops()

    def _write(self, reading: Reading) -> None:
        message, kind = reading.message, type(reading.message).__name__
        try:
            suffix = self._topics.suffix(message, reading.device)
            self._writer.write(message, reading.arrived, suffix)
        except OSError:
            raise
        except Exception as error:  # one bad message must not end the recording
            if not isinstance(error, MessageError):
                log.exception("recorder: %s", reading.device)
            self._refused[kind] += 1
            if self._refused[kind] == 1:
                self._notify("warning", f"{reading.device}: {kind} cannot be recorded: {error}")
        else:
            self._unsynced[kind] += 1

    def _report_drops(self) -> None:
        """Notify when the queue begins to drop readings, and of the counts when it has recovered."""
        dropped = self._queue.dropped()
        before, self._dropped = self._dropped, dropped.total()
        was_dropping, self._dropping = self._dropping, self._dropped > before
        if self._dropping and not was_dropping:
            self._notify("warning", f"{self.path.name}: the disk is too slow; readings are dropped")
        elif was_dropping and not self._dropping:
            counts = ", ".join(f"{count} {kind}" for kind, count in sorted(dropped.items()))
            self._notify("warning", f"{self.path.name}: dropped so far: {counts}")
