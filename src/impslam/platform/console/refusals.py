"""What was refused, told in the log: the first of a kind at once, the rest as a count.

A thousand refusals a minute must neither hide among others nor fill the disk.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

log = logging.getLogger(__name__)

FIRST = 5  # of each kind and address are told one by one
WINDOW = 60.0  # s, then the rest is told as one count
MOST = 256  # kinds and addresses kept apart; all beyond are told as one
LONGEST = 120  # characters of what a request said of itself


@dataclass(slots=True)
class _Count:
    begun: float
    number: int = 0


class Refusals:
    """Tells the log of refusals, at a bounded rate.

    Parameters
    ----------
    clock : s, never stepping back
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, str], _Count] = {}

    def tell(self, address: str, what: str, detail: str = "") -> None:
        """Note one refusal: to whom, what kind, and what it was about (never a secret)."""
        with self._lock:
            key = (address, what)
            if key not in self._counts and len(self._counts) >= MOST:
                key = ("others", "requests")
            count = self._counts.setdefault(key, _Count(self._clock()))
            count.number += 1
        if count.number <= FIRST:
            log.warning("refused %s: %s%s", *key, f" ({shown(detail)})" if detail else "")

    def flush(self, *, everything: bool = False) -> None:
        """Tell the counts whose time is up; call it about once a second, and at the end."""
        moment = self._clock()
        with self._lock:
            due = {
                key: count
                for key, count in self._counts.items()
                if everything or moment - count.begun >= WINDOW
            }
            for key in due:
                del self._counts[key]
        for (address, what), count in due.items():
            if (more := count.number - FIRST) > 0:
                seconds = moment - count.begun
                log.warning("refused %s: %s: %d more in %.0f s", address, what, more, seconds)


def shown(text: str) -> str:
    """Return text from outside as one short line of plain characters, fit for a log."""
    plain = text.encode("ascii", "backslashreplace").decode()
    plain = "".join(letter if letter.isprintable() else f"\\x{ord(letter):02x}" for letter in plain)
    return plain if len(plain) <= LONGEST else plain[: LONGEST - 3] + "..."
