"""Log refusals and logins: the first of a kind at once, the rest as a count.

A thousand refusals or logins a minute must neither hide other lines nor fill the disk.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from impslam.platform.console.throttle import Bucket

log = logging.getLogger(__name__)

FIRST = 5  # of each kind, logged one by one
WINDOW = 60.0  # s, then the rest is logged as one count
MAX_KINDS = 256  # kinds counted separately; all others are logged as one
LINE_BURST, RATE = 10, 1.0  # lines at once, and per second in the long run
MAX_DETAIL_LENGTH = 120  # characters of details from a request

_Kind = tuple[int, str]  # level, and what the line begins with
_OTHERS: _Kind = (logging.WARNING, "refused others: requests")


@dataclass(slots=True)
class _Count:
    begun: float
    number: int = 0
    logged: int = 0


class Refusals:
    """Logs refusals and logins at a bounded rate.

    Parameters
    ----------
    clock : monotonic time, s
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._lines = Bucket(LINE_BURST, RATE, clock)
        self._counts: dict[_Kind, _Count] = {}
        self._closed = False

    def close(self) -> None:
        """Log all counts, and nothing more: what is cut off while the server stops is no refusal."""
        self.flush(everything=True)
        self._closed = True

    def record(self, address: str, what: str, detail: str = "") -> None:
        """Record a refusal: the client, the kind, and details (never a secret)."""
        self._note((logging.WARNING, f"refused {address}: {what}"), detail)

    def admit(self, address: str, what: str, detail: str = "") -> None:
        """Record a granted access: the client, the kind, and details (never a secret)."""
        self._note((logging.INFO, f"{address} {what}"), detail)

    def flush(self, *, everything: bool = False) -> None:
        """Log the counts of expired windows; call it about once a second, and at the end."""
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
        if self._closed:
            return
        with self._lock:
            if kind not in self._counts and len(self._counts) >= MAX_KINDS:
                kind = _OTHERS
            count = self._counts.setdefault(kind, _Count(self._clock()))
            count.number += 1
            if count.number > FIRST or self._lines.wait() > 0.0:
                return
            count.logged += 1
        level, what = kind
        log.log(level, "%s%s", what, f" ({sanitised(detail)})" if detail else "")

    @staticmethod
    def _write(kind: _Kind, more: int, seconds: float) -> None:
        level, what = kind
        log.log(level, "%s: %d more in %.0f s", what, more, seconds)


def sanitised(text: str) -> str:
    """Return untrusted text as one short line of printable ASCII, for the log."""
    plain = text.encode("ascii", "backslashreplace").decode()
    plain = "".join(letter if letter.isprintable() else f"\\x{ord(letter):02x}" for letter in plain)
    return plain if len(plain) <= MAX_DETAIL_LENGTH else plain[: MAX_DETAIL_LENGTH - 3] + "..."
