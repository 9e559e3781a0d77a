"""Sessions: one for each login, stored only on the server.

A session ends after `IDLE_TIMEOUT` without use, after `LIFETIME`, on logout, and when a password
changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

Right = Literal["watch", "drive"]

IDLE_TIMEOUT = 30 * 60.0  # s without a request or a message; longer than a pause in driving
LIFETIME = 12 * 3600.0  # s since the login: one working day


class Session:
    """One login.

    Attributes
    ----------
    id : identifies the session, e.g. for drive control; not secret, and not accepted as a token
    name : name on the page: "driver 1", "watcher 2"
    may_drive : whether it may change anything, or only watch
    address : address of the login
    used : time of the last use, s of the clock
    """

    def __init__(
        self,
        ident: str,
        name: str,
        *,
        may_drive: bool,
        address: str = "",
        report: Callable[[str, str], None] = lambda what, detail: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.id, self.name, self.may_drive, self.address = ident, name, may_drive, address
        self._report, self._clock = report, clock
        self._begun = self.used = clock()
        self._ended = False

    def __repr__(self) -> str:
        return f"Session({self.id}, {self.name})"

    def alive(self) -> bool:
        """Return whether the session is valid; check before each command."""
        moment = self._clock()
        fresh = moment - self.used < IDLE_TIMEOUT and moment - self._begun < LIFETIME
        return fresh and not self._ended

    def refused(self, reason: str) -> None:
        """Report that a command from its pages was refused."""
        self._report(f"a command of {self.name}", reason)

    def use(self) -> None:
        """Record a use now; an ended session stays ended."""
        if self.alive():
            self.used = self._clock()

    def end(self) -> None:
        """End the session permanently."""
        self._ended = True
