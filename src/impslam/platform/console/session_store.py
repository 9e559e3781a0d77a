"""The sessions of a server, found by the token that a browser holds.

The token is 256 random bits; the server keeps only its SHA-256, so that what it holds opens nothing.
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

MOST = 64  # sessions of a right; a robot has a handful of people, and each costs memory
EACH = 16  # of them from one address, so that who logs in again and again ends their own alone
TOKEN = 32  # bytes of a token


class Sessions:
    """All sessions, found by the token that their browsers hold.

    Parameters
    ----------
    clock : s, never stepping back
    report : called with (address, what, detail) for what is refused to a session
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

        Where `MOST` of the right are held, or `EACH` from the address, the one of them ends that was
        not used for longest: who may watch never ends the session of who may drive.
        """
        token = secrets.token_urlsafe(TOKEN)
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
        """Return the session of a token, None where it never was or has ended."""
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
        """Drop what has ended, and end what was not used for longest where there are too many."""
        kept = {key: one for key, one in self._by_digest.items() if one.alive()}
        alike = [key for key, one in kept.items() if one.may_drive == new.may_drive]
        alike.sort(key=lambda key: kept[key].used)
        same = [key for key in alike if kept[key].address == new.address]
        for key in {*same[: max(0, len(same) - EACH + 1)], *alike[: max(0, len(alike) - MOST + 1)]}:
            kept.pop(key).end()
        self._by_digest = kept


def digest(token: str) -> bytes:
    """Return what is kept of a token; a lookup by it tells nothing of how near a guess was."""
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()
