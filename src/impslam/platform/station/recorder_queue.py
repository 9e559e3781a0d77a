"""The bounded, non-blocking queue of the recorder; it drops the least important types first."""

from __future__ import annotations

import threading
from collections import Counter

from impslam.platform.devices.base import Reading
from impslam.types import Event, Image, LaserScan, Message, WheelAngles

MAX_READINGS = 40_000
"""readings; 40 s of an autopilot's 600, a lidar and a camera, or 10 s of 4000 a second."""
MAX_BYTES = 64 * 2**20  # 0.4 MB a second with scans and pictures: two minutes of a stalled disk
SMALL_SIZE = 400  # bytes of memory of a reading of a few numbers

MAX_FILL = {Image: 0.5, LaserScan: 1.0, WheelAngles: 1.0, Event: 1.0}
"""Fill of the queue above which a type is dropped; a map needs only scans and wheels."""
DEFAULT_MAX_FILL = 0.75


class ReadingQueue:
    """A queue of readings; if it is too full for a type, a reading is dropped and counted."""

    def __init__(self, count: int = MAX_READINGS, size: int = MAX_BYTES) -> None:
        self._count, self._size = count, size
        self._lock = threading.Lock()
        self._readings: list[Reading] = []
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._open = True

    def put(self, reading: Reading) -> None:
        """Add a reading, or drop and count it; do nothing once closed."""
        kind, size = type(reading.message), _size(reading.message)
        with self._lock:
            if not self._open:
                return
            count, total = len(self._readings) + 1, self._bytes + size
            if max(count / self._count, total / self._size) > MAX_FILL.get(kind, DEFAULT_MAX_FILL):
                self._dropped[kind.__name__] += 1
                return
            self._readings.append(reading)
            self._bytes = total

    def __len__(self) -> int:
        """Return the number of waiting readings."""
        return len(self._readings)

    def take(self) -> list[Reading]:
        """Remove and return all readings, sorted by arrival: threads may have put them out of order."""
        with self._lock:
            readings, self._readings, self._bytes = self._readings, [], 0
        return sorted(readings, key=lambda reading: reading.arrived)

    def close(self) -> None:
        """Accept no more readings; waiting ones can still be taken."""
        with self._lock:
            self._open = False

    def dropped(self) -> Counter[str]:
        """Return the number of dropped readings by type."""
        with self._lock:
            return self._dropped.copy()


def _size(message: Message) -> int:
    """Return the approximate memory of a message, bytes."""
    if isinstance(message, Image):
        return SMALL_SIZE + len(message.data)
    if isinstance(message, LaserScan):
        return SMALL_SIZE + 4 * message.ranges.nbytes
    return SMALL_SIZE
