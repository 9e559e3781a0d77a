"""The queue between what senses and what maps: whole scans are dropped from it, motion never."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from impslam.types import Message

SCANS = 3
"""Scans that may wait: 0.3 s at 10 Hz. More would only make the map older, fewer would drop scans
for a hiccup of the computer."""
LIMIT = 60_000
"""Messages that may wait: ten minutes of odometry at 100 Hz, in 10 MB."""


@dataclass(slots=True, eq=False)
class Entry:
    """A message that waits; None once it is dropped."""

    message: Message | None
    arrived: float


class Inbox:
    """A queue of messages in the order in which they came.

    When more than `scans` scans wait the oldest of them is dropped and counted: the newest tells
    most about where the robot is now, and what they have in common is lost with none. Messages of
    motion stay, since each says what the others do not. `dropped_at` is monotonic time.
    """

    def __init__(self, scans: int = SCANS) -> None:
        self._most = scans
        self._entries: deque[Entry] = deque()
        self._scans: deque[Entry] = deque()
        self._changed = threading.Condition()
        self._woken = False
        self.dropped, self.dropped_at = 0, float("-inf")

    def put(self, message: Message, arrived: float, is_scan: bool) -> bool:
        """Take a message from any thread; tell whether there was room."""
        with self._changed:
            if len(self._entries) >= LIMIT:
                return False
            entry = Entry(message, arrived)
            self._entries.append(entry)
            if is_scan:
                self._scans.append(entry)
                if len(self._scans) > self._most:
                    self._scans.popleft().message = None
                    self.dropped, self.dropped_at = self.dropped + 1, time.monotonic()
            self._changed.notify()
            return True

    def take(self, timeout: float | None = None) -> tuple[Message, float] | None:
        """Return the next message and when it arrived; None after `timeout` s, or if woken."""
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
        """Make who waits in `take` look up."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    @property
    def empty(self) -> bool:
        """Tell whether nothing waits."""
        return not self._entries

    @property
    def waiting(self) -> int:
        """How many scans wait."""
        return len(self._scans)
