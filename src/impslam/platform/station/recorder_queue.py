"""What waits to be written: bounded, never blocking, and giving up first what is missed least."""

from __future__ import annotations

import threading
from collections import Counter

from impslam.platform.devices.base import Reading
from impslam.types import Event, Image, LaserScan, Message, WheelAngles

COUNT = (
    40_000  # readings; 40 s of an autopilot's 600, a lidar and a camera, or 10 s of 4000 a second
)
BYTES = 64 * 2**20  # 0.4 MB a second with scans and pictures: two minutes of a stalled disk
SMALL = 400  # bytes that a reading of a few numbers takes in memory

FULL = {Image: 0.5, LaserScan: 1.0, WheelAngles: 1.0, Event: 1.0}
"""Share of the queue from which on a type is refused; a map needs scans and wheels alone."""
OTHERS_FULL = 0.75


class ReadingQueue:
    """Readings in the order in which they came; a type that finds it too full is dropped, counted."""

    def __init__(self, count: int = COUNT, size: int = BYTES) -> None:
        self._count, self._size = count, size
        self._lock = threading.Lock()
        self._readings: list[Reading] = []
        self._bytes = 0
        self._dropped: Counter[str] = Counter()
        self._open = True

    def put(self, reading: Reading) -> None:
        """Take a reading, or drop and count it; once closed, nothing happens."""
        kind, size = type(reading.message), _size(reading.message)
        with self._lock:
            if not self._open:
                return
            count, total = len(self._readings) + 1, self._bytes + size
            if max(count / self._count, total / self._size) > FULL.get(kind, OTHERS_FULL):
                self._dropped[kind.__name__] += 1
                return
            self._readings.append(reading)
            self._bytes = total

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._readings)

    def take(self) -> list[Reading]:
        """Return all that waits, by time of arrival: threads may have overtaken one another."""
        with self._lock:
            readings, self._readings, self._bytes = self._readings, [], 0
        return sorted(readings, key=lambda reading: reading.arrived)

    def close(self) -> None:
        """Take no more; what waits can still be taken."""
        with self._lock:
            self._open = False

    def dropped(self) -> Counter[str]:
        """Return how many were dropped, by type."""
        with self._lock:
            return self._dropped.copy()


def _size(message: Message) -> int:
    """Return about how many bytes a message holds on to."""
    if isinstance(message, Image):
        return SMALL + len(message.data)
    if isinstance(message, LaserScan):
        return SMALL + 4 * message.ranges.nbytes
    return SMALL
