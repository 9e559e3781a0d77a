"""Who is on the page: one session for each login, held by the server alone.

A session ends when nobody has used it for `IDLE`, when it is `LIFE` old, on logout, and when a password
changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

Right = Literal["watch", "drive"]

IDLE = 30 * 60.0  # s without a request or a message: longer than a pause, shorter than a lunch
LIFE = 12 * 3600.0  # s since the login: one working day


class Session:
    """One login; the page asks it who commands, and whether they still may.

    Attributes
    ----------
    id : names the session, to the helm for example; not secret, and opens nothing
    name : how this one is called on the page: "driver 1", "watcher 2"
    may_drive : whether it may change anything; who may not, may watch
    address : where it was begun
    used : s of the clock, when it was last in use
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
        """Return whether it still holds; ask before each command."""
        moment = self._clock()
        fresh = moment - self.used < IDLE and moment - self._begun < LIFE
        return fresh and not self._ended

    def refused(self, reason: str) -> None:
        """Tell the log that a command from its pages was refused."""
        self._report(f"a command of {self.name}", reason)

    def use(self) -> None:
        """Note that it is in use now; does not wake a session that has ended."""
        if self.alive():
            self.used = self._clock()

    def end(self) -> None:
        """End it, for good."""
        self._ended = True
