"""The queue between the devices and the mapper; it drops whole scans, never motion."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_SCANS = 3
"""Scans that may wait: 0.3 s at 10 Hz. More would delay the map, fewer would drop scans at a short
stall of the computer."""
MAX_MESSAGES = 60_000
"""Messages that may wait: five minutes of encoders and gyro at 100 Hz each, in 10 MB."""


@dataclass(slots=True, eq=False)
class Entry(Generic[T]):
    """A waiting message; None once it is dropped."""

    message: T | None
    arrived: float


class Inbox(Generic[T]):
    """A queue of messages in order of arrival.

    When more than `scans` scans wait, the oldest is dropped and counted: consecutive scans overlap,
    and the newest matters most for the present pose. Motion is never dropped, since no other message
    replaces it. `dropped_at` is monotonic time.
    """

    def __init__(self, scans: int = MAX_SCANS) -> None:
        self._max_scans = scans
        self._entries: deque[Entry[T]] = deque()
        self._scans: deque[Entry[T]] = deque()
        self._changed = threading.Condition()
        self._woken = False
        self.dropped, self.dropped_at = 0, float("-inf")

    def put(self, message: T, arrived: float, is_scan: bool) -> bool:
        """Add a message, from any thread; return whether there was room."""
        with self._changed:
            if len(self._entries) >= MAX_MESSAGES:
                return False
            entry = Entry(message, arrived)
            self._entries.append(entry)
            if is_scan:
                self._scans.append(entry)
                if len(self._scans) > self._max_scans:
                    self._scans.popleft().message = None
                    self.dropped, self.dropped_at = self.dropped + 1, time.monotonic()
            self._changed.notify()
            return True

    def take(self, timeout: float | None = None) -> tuple[T, float] | None:
        """Return the next message and its arrival time; None after `timeout` s, or if woken."""
        with self._changed:
            self._changed.wait_for(lambda: self._entries or self._woken, timeout)
            self._woken = False
            while self._entries:
                entry = self._entries.popleft()
                if self._scans and self._scans[0] is entry:
                    self._scans.popleft()
                if entry.message is not None:
                    return entry.message, entry.arrived
            return None

    def wake(self) -> None:
        """Make a waiting `take` return."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    @property
    def empty(self) -> bool:
        """Whether nothing waits."""
        return not self._entries

    @property
    def waiting(self) -> int:
        """Number of waiting scans."""
        return len(self._scans)
