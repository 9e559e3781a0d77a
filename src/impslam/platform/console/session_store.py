"""The sessions of a server, found by the token of a browser.

The token is 256 random bits; the server keeps only its SHA-256, which is useless for a login.
"""

from __future__ import annotations

import hashlib
import itertools
import secrets
import threading
import time
from collections.abc import Callable
from functools import partial

from impslam.platform.console.session import Right, Session

MAX_SESSIONS = 64  # sessions of a right; a robot has a handful of users, and each costs memory
MAX_PER_ADDRESS = 16  # of these; repeated logins from one address end only its own sessions
TOKEN_SIZE = 32  # bytes


class Sessions:
    """All sessions, found by the token of their browser.

    Parameters
    ----------
    clock : monotonic time, s
    report : called with (address, what, detail) when a session is refused something
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        report: Callable[[str, str, str], None] = lambda address, what, detail: None,
    ) -> None:
        self._clock, self._report = clock, report
        self._lock = threading.Lock()
        self._by_digest: dict[bytes, Session] = {}
        self._numbers = itertools.count(1)

    def begin(self, right: Right, address: str = "") -> tuple[str, Session]:
        """Begin a session; return the token for the browser, and the session.

        At the limits `MAX_SESSIONS` of the right or `MAX_PER_ADDRESS`, the least recently used session
        of the same right ends: a watcher never ends a driver's session.
        """
        token = secrets.token_urlsafe(TOKEN_SIZE)
        number = next(self._numbers)
        name = f"{'driver' if right == 'drive' else 'watcher'} {number}"
        session = Session(
            f"{number}-{secrets.token_hex(4)}",
            name,
            may_drive=right == "drive",
            address=address,
            report=partial(self._report, address),
            clock=self._clock,
        )
        with self._lock:
            self._make_room(session)
            self._by_digest[digest(token)] = session
        return token, session

    def find(self, token: str) -> Session | None:
        """Return the session of a token, None if it never existed or has ended."""
        with self._lock:
            session = self._by_digest.get(digest(token))
        return session if session is not None and session.alive() else None

    def end_all(self) -> None:
        """End every session: a password has changed, or the server stops."""
        with self._lock:
            for session in self._by_digest.values():
                session.end()
            self._by_digest.clear()

    def _make_room(self, new: Session) -> None:
        """Drop ended sessions, and end the least recently used ones if there are too many."""
        kept = {key: one for key, one in self._by_digest.items() if one.alive()}
        alike = [key for key, one in kept.items() if one.may_drive == new.may_drive]
        alike.sort(key=lambda key: kept[key].used)
        same = [key for key in alike if kept[key].address == new.address]
        for key in {
            *same[: max(0, len(same) - MAX_PER_ADDRESS + 1)],
            *alike[: max(0, len(alike) - MAX_SESSIONS + 1)],
        }:
            kept.pop(key).end()
        self._by_digest = kept


def digest(token: str) -> bytes:
    """Return the stored hash of a token; a lookup by it leaks nothing about a guess by its timing."""
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()
