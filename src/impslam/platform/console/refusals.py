"""What strangers and watchers cause in the log: the first of a kind at once, the rest as a count.

A thousand refusals a minute must neither hide among others nor fill the disk, and a thousand logins
no more than they.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from impslam.platform.console.throttle import Bucket

log = logging.getLogger(__name__)

FIRST = 5  # of each kind are logged one by one
WINDOW = 60.0  # s, then the rest is logged as one count
MOST = 256  # kinds kept apart; all beyond are logged as one
LINES, RATE = 10, 1.0  # lines at once, and a second in the long run
LONGEST = 120  # characters of what a request said of itself

_Kind = tuple[int, str]  # level, and what the line begins with
_OTHERS: _Kind = (logging.WARNING, "refused others: requests")


@dataclass(slots=True)
class _Count:
    begun: float
    number: int = 0
    logged: int = 0


class Refusals:
    """Tells the log of refusals and logins, at a bounded rate.

    Parameters
    ----------
    clock : s, never stepping back
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._lines = Bucket(LINES, RATE, clock)
        self._counts: dict[_Kind, _Count] = {}

    def record(self, address: str, what: str, detail: str = "") -> None:
        """Note one refusal: to whom, what kind, and what it was about (never a secret)."""
        self._note((logging.WARNING, f"refused {address}: {what}"), detail)

    def admit(self, address: str, what: str, detail: str = "") -> None:
        """Note what an address was let do: what kind, and more about it (never a secret)."""
        self._note((logging.INFO, f"{address} {what}"), detail)

    def flush(self, *, everything: bool = False) -> None:
        """Tell the counts whose time is up; call it about once a second, and at the end."""
        moment, others = self._clock(), 0
        with self._lock:
            for kind, count in list(self._counts.items()):
                if not everything and moment - count.begun < WINDOW:
                    continue
                more = count.number - count.logged
                if more > 0 and self._lines.wait() > 0.0:
                    if not everything:
                        continue  # when there is room for a line
                    others, more = others + more, 0
                del self._counts[kind]
                if more > 0:
                    self._write(kind, more, moment - count.begun)
            if others:
                self._write(_OTHERS, others, 0.0)

    def _note(self, kind: _Kind, detail: str) -> None:
        with self._lock:
            if kind not in self._counts and len(self._counts) >= MOST:
                kind = _OTHERS
            count = self._counts.setdefault(kind, _Count(self._clock()))
            count.number += 1
            if count.number > FIRST or self._lines.wait() > 0.0:
                return
            count.logged += 1
        level, what = kind
        log.log(level, "%s%s", what, f" ({shown(detail)})" if detail else "")

    @staticmethod
    def _write(kind: _Kind, more: int, seconds: float) -> None:
        level, what = kind
        log.log(level, "%s: %d more in %.0f s", what, more, seconds)


def shown(text: str) -> str:
    """Return text from outside as one short line of plain characters, fit for a log."""
    plain = text.encode("ascii", "backslashreplace").decode()
    plain = "".join(letter if letter.isprintable() else f"\\x{ord(letter):02x}" for letter in plain)
    return plain if len(plain) <= LONGEST else plain[: LONGEST - 3] + "..."
