"""How often a login may be tried: asked before any hash is computed, so that trying costs nothing.

Each address has a few free tries, then waits, twice as long after each. All addresses together
have what one core spares. Whoever waits is refused with the right password too: one that is let
through would tell a guesser that it was right. Who comes from another address is not held up, as
long as fewer than `TOGETHER` tries a minute fail in all. Right ones do not count, however many.
"""

from __future__ import annotations

import ipaddress
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from impslam.platform.console import hosts

FREE = 3  # tries: a person mistypes
LONGEST = 300.0  # s to wait at most, so that a person who forgot gets in again within minutes
FORGET = 900.0  # s after the last try an address starts anew; longer than `LONGEST`
TOGETHER = 20  # hashes a minute in all: 0.1 s each on an ARM board, so 3 % of a core
MOST = 4096  # addresses remembered


@dataclass(slots=True)
class _Tries:
    count: int
    last: float


class Bucket:
    """A token bucket: `most` at once, and `rate` a second in the long run."""

    def __init__(self, most: float, rate: float, clock: Callable[[], float]) -> None:
        self._most, self._rate, self._clock = most, rate, clock
        self._level, self._at = most, clock()

    def wait(self) -> float:
        """Take one token and return 0, or return how many s it takes until there is one."""
        moment = self._clock()
        self._level = min(self._most, self._level + (moment - self._at) * self._rate)
        self._at = moment
        if self._level < 1.0:
            return (1.0 - self._level) / self._rate
        self._level -= 1.0
        return 0.0

    def give_back(self) -> None:
        """Put a token back that was not needed."""
        self._level = min(self._most, self._level + 1.0)


class Throttle:
    """Counts the tries of each address, and of all.

    Parameters
    ----------
    clock : s, never stepping back
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._tries: dict[str, _Tries] = {}
        self._all = Bucket(TOGETHER, TOGETHER / 60.0, clock)

    def wait(self, address: str) -> float:
        """Count one try and return 0, or return how many s the address has to wait.

        The try counts as failed until `forgive`, so that many at a time do not slip through; one
        that is not admitted does not count, so that nobody waits for ever.
        """
        key, moment = _block(address), self._clock()
        with self._lock:
            tries = self._tries.get(key)
            if tries is None or moment - tries.last >= FORGET:
                tries = _Tries(0, moment)
            wait = _pause(tries.count) - (moment - tries.last) if tries.count >= FREE else 0.0
            if wait <= 0.0:
                wait = self._all.wait()
            if wait <= 0.0:
                self._note(key, _Tries(tries.count + 1, moment))
            return max(wait, 0.0)

    def forgive(self, address: str, *, wholly: bool = True) -> None:
        """Take the last try of an address back, which was right; `wholly` those before it too.

        Who knows the password to watch may be guessing the one to drive, and must not start anew.
        """
        key = _block(address)
        with self._lock:
            self._all.give_back()
            tries = self._tries.pop(key, None)
            if tries is not None and tries.count > 1 and not wholly:
                self._note(key, _Tries(tries.count - 1, tries.last))

    def _note(self, key: str, tries: _Tries) -> None:
        self._tries.pop(key, None)  # so that the dict is in the order of the last tries
        self._tries[key] = tries
        if len(self._tries) > MOST:
            del self._tries[next(iter(self._tries))]


def _pause(count: int) -> float:
    """Return s to wait after `count` failed tries: 2, 4, 8, ..., `LONGEST`."""
    return float(min(2.0 ** (min(count, 16) - FREE + 1), LONGEST))


def _block(address: str) -> str:
    """Return what one person can call theirs: an IPv4 address, or the /64 of an IPv6 one."""
    try:
        found = hosts.ip(address)
    except ValueError:
        return address
    if found.version == 4:
        return str(found)
    return str(ipaddress.ip_network((found, 64), strict=False))
