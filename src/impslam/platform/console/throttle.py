"""Limit the rate of login tries, before any hash is computed.

Each address has a few free tries, then must wait, twice as long after each. In addition, all addresses
share `TRIES_PER_MINUTE`, which bounds the load of a core; as long as fewer tries fail, other addresses
are not delayed. While an address must wait, it is refused with the correct password as well, or a
guesser would learn that it is correct. Correct passwords do not count.
"""

from __future__ import annotations

import ipaddress
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from impslam.platform.console import hosts

FREE_TRIES = 3  # people mistype
MAX_WAIT = 300.0  # s, so that a person who mistyped can log in again within minutes
RESET_TIME = 900.0
"""s after the last try, the count of an address starts again; longer than `MAX_WAIT`."""
TRIES_PER_MINUTE = 20  # in total: hashes of 0.1 s on an ARM board, so 3 % of a core
MAX_ADDRESSES = 4096  # addresses remembered


@dataclass(slots=True)
class _Tries:
    count: int
    last: float


class Bucket:
    """A token bucket: `capacity` tokens at once, and `rate` per second in the long run."""

    def __init__(self, capacity: float, rate: float, clock: Callable[[], float]) -> None:
        self._capacity, self._rate, self._clock = capacity, rate, clock
        self._level, self._at = capacity, clock()

    def wait(self) -> float:
        """Take one token and return 0, or return the time until there is one, s."""
        moment = self._clock()
        self._level = min(self._capacity, self._level + (moment - self._at) * self._rate)
        self._at = moment
        if self._level < 1.0:
            return (1.0 - self._level) / self._rate
        self._level -= 1.0
        return 0.0

    def give_back(self) -> None:
        """Put back a token that was not needed."""
        self._level = min(self._capacity, self._level + 1.0)


class Throttle:
    """Counts the tries of each address, and of all.

    Parameters
    ----------
    clock : monotonic time, s
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._tries: dict[str, _Tries] = {}
        self._shared_bucket = Bucket(TRIES_PER_MINUTE, TRIES_PER_MINUTE / 60.0, clock)

    def wait(self, address: str) -> float:
        """Count a try and return 0, or return how long the address must wait, s.

        The try counts as failed until `forgive`, which also limits simultaneous tries; a refused try
        does not count, so that nobody waits for ever.
        """
        key, moment = _client_key(address), self._clock()
        with self._lock:
            tries = self._tries.get(key)
            if tries is None or moment - tries.last >= RESET_TIME:
                tries = _Tries(0, moment)
            wait = _pause(tries.count) - (moment - tries.last) if tries.count >= FREE_TRIES else 0.0
            if wait <= 0.0:
                wait = self._shared_bucket.wait()
            if wait <= 0.0:
                self._remember(key, _Tries(tries.count + 1, moment))
            return max(wait, 0.0)

    def forgive(self, address: str, *, wholly: bool = True) -> None:
        """Take back the last try of an address, as it was correct; with `wholly`, the earlier ones too.

        Someone with the password to watch may be guessing the one to drive, and must not start again.
        """
        key = _client_key(address)
        with self._lock:
            self._shared_bucket.give_back()
            tries = self._tries.pop(key, None)
            if tries is not None and tries.count > 1 and not wholly:
                self._remember(key, _Tries(tries.count - 1, tries.last))

    def _remember(self, key: str, tries: _Tries) -> None:
        self._tries.pop(key, None)  # keeps the dict in the order of the last tries
        self._tries[key] = tries
        if len(self._tries) > MAX_ADDRESSES:
            del self._tries[next(iter(self._tries))]


def _pause(count: int) -> float:
    """Return the wait after `count` failed tries, s: 2, 4, 8, ..., `MAX_WAIT`."""
    return float(min(2.0 ** (min(count, 16) - FREE_TRIES + 1), MAX_WAIT))


def _client_key(address: str) -> str:
    """Return the block of addresses that one client has: an IPv4 address, or an IPv6 /64."""
    try:
        found = hosts.ip(address)
    except ValueError:
        return address
    if found.version == 4:
        return str(found)
    return str(ipaddress.ip_network((found, 64), strict=False))
