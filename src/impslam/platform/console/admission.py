"""Limit the server time of watchers and strangers: one request at a time, then a pause.

The page, its toolkit and the driver's commands share one thread. Whatever a request costs there (an
ARM board takes 100 ms to build a page), the thread stays free for as long as a request of a watcher
has kept it busy, and the same applies to strangers. Excess requests are refused. Requests of drivers
are never delayed.
"""

from __future__ import annotations

import asyncio
from collections import Counter

from starlette.types import Message, Send

from impslam.platform.console.request import IncomingRequest
from impslam.platform.console.session import Session

MAX_PER_CLIENT = 8  # waiting requests of a session, or of an address; a browser sends 6 at a time
MAX_WAITING = 64  # waiting requests in total: some 2 s on a laptop
WAIT_TIMEOUT = 10.0  # s that a request waits
PAUSE_RATIO = 1.0  # pause after a request, as a share of the time that it took
MAX_PAUSE = 0.5  # s
MAX_SOCKETS = 32  # open at a time, of all watchers


class RequestTurn:
    """The time in which one request is processed; ends with its first answer."""

    def __init__(self, lock: asyncio.Lock | None) -> None:
        self._lock = lock
        self._loop = asyncio.get_running_loop()
        self._begun = self._loop.time()

    def end(self) -> None:
        """Let the next request in, after a pause."""
        if self._lock is not None:
            pause = min(PAUSE_RATIO * (self._loop.time() - self._begun), MAX_PAUSE)
            self._loop.call_later(pause, self._lock.release)
            self._lock = None

    def ended_by(self, send: Send) -> Send:
        """Return a `send` that ends the turn: from then on, the request only waits for the network."""

        async def ending(message: Message) -> None:
            self.end()
            await send(message)

        return ending


class Lane:
    """Requests that are processed one after the other, in order of arrival."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._waiting: Counter[str] = Counter()

    async def turn(self, key: str) -> RequestTurn | None:
        """Wait for a turn; return None if too many wait, of `key` or in total, or for too long."""
        if self._waiting[key] >= MAX_PER_CLIENT or self._waiting.total() >= MAX_WAITING:
            return None
        self._waiting[key] += 1
        try:
            async with asyncio.timeout(WAIT_TIMEOUT):
                await self._lock.acquire()
        except TimeoutError:
            return None
        finally:
            self._waiting[key] -= 1
            self._waiting += Counter()  # drops zeros, so that memory is bounded
        return RequestTurn(self._lock)


class Admission:
    """Lanes for strangers, for watchers, and for files, since some take long to prepare."""

    def __init__(self) -> None:
        self._strangers, self._watchers, self._files = Lane(), Lane(), Lane()

    async def turn(self, request: IncomingRequest, session: Session | None) -> RequestTurn | None:
        """Wait until a request may be processed; return None if it must be refused."""
        if session is None:
            return await self._strangers.turn(request.address)
        if session.may_drive:
            return RequestTurn(None)
        lane = self._files if request.by_script else self._watchers
        return await lane.turn(f"{request.address} {session.id}")


class Sockets:
    """Limits the open sockets of watchers."""

    def __init__(self) -> None:
        self._open: Counter[str] = Counter()

    def take(self, session: Session) -> bool:
        """Take a socket for a session; return whether one was free. `leave` gives it back."""
        if session.may_drive:
            return True
        if self._open[session.id] >= MAX_PER_CLIENT or self._open.total() >= MAX_SOCKETS:
            return False
        self._open[session.id] += 1
        return True

    def leave(self, session: Session) -> None:
        """Give a socket back."""
        if not session.may_drive:
            self._open[session.id] -= 1
            self._open += Counter()
