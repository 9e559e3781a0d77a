"""How much of the server those take who may not drive: one request at a time, then a pause.

The page, its toolkit and the driver's commands share one thread. Whatever a request costs there (an
ARM board takes 100 ms to build a page), the requests of watchers leave the thread free for as long
as they kept it busy, and so do those of strangers. Who sends more than is worked on is told to wait.
Requests of drivers are never held up.
"""

from __future__ import annotations

import asyncio
from collections import Counter

from starlette.types import Message, Send

from impslam.platform.console.request import IncomingRequest
from impslam.platform.console.session import Session

EACH = (
    8  # requests of one session, or of one address without, that wait; a browser sends 6 at a time
)
QUEUE = 64  # that wait in all: some 2 s on a laptop
PATIENCE = 10.0  # s that one waits
PAUSE = 1.0  # of the time that a request took is left free after it
LONGEST = 0.5  # s of a pause
SOCKETS = 32  # open at a time, of all who may not drive


class Turn:
    """The time in which one request is worked on; ends with its first answer."""

    def __init__(self, lock: asyncio.Lock | None) -> None:
        self._lock = lock
        self._loop = asyncio.get_running_loop()
        self._begun = self._loop.time()

    def end(self) -> None:
        """Let the next one in, after a pause."""
        if self._lock is not None:
            pause = min(PAUSE * (self._loop.time() - self._begun), LONGEST)
            self._loop.call_later(pause, self._lock.release)
            self._lock = None

    def ended_by(self, send: Send) -> Send:
        """Return a `send` that ends the turn: what is sent from then on waits for the network."""

        async def ending(message: Message) -> None:
            self.end()
            await send(message)

        return ending


class Lane:
    """Requests that are worked on one after the other, in the order in which they came."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._waiting: Counter[str] = Counter()

    async def turn(self, key: str) -> Turn | None:
        """Wait for a turn; return None where too many wait, of `key` or in all, or for too long."""
        if self._waiting[key] >= EACH or self._waiting.total() >= QUEUE:
            return None
        self._waiting[key] += 1
        try:
            async with asyncio.timeout(PATIENCE):
                await self._lock.acquire()
        except TimeoutError:
            return None
        finally:
            self._waiting[key] -= 1
            self._waiting += Counter()  # drops what is zero, so that memory is bounded
        return Turn(self._lock)


class Admission:
    """Lanes for strangers, for watchers, and for files, of which some take long to prepare."""

    def __init__(self) -> None:
        self._strangers, self._watchers, self._files = Lane(), Lane(), Lane()

    async def turn(self, request: IncomingRequest, session: Session | None) -> Turn | None:
        """Wait until a request may be worked on; return None where it may not."""
        if session is None:
            return await self._strangers.turn(request.address)
        if session.may_drive:
            return Turn(None)
        lane = self._files if request.by_script else self._watchers
        return await lane.turn(f"{request.address} {session.id}")


class Sockets:
    """Counts the open sockets of those who may not drive."""

    def __init__(self) -> None:
        self._open: Counter[str] = Counter()

    def take(self, session: Session) -> bool:
        """Return whether a session may have one more; `leave` gives it back."""
        if session.may_drive:
            return True
        if self._open[session.id] >= EACH or self._open.total() >= SOCKETS:
            return False
        self._open[session.id] += 1
        return True

    def leave(self, session: Session) -> None:
        """Count one less."""
        if not session.may_drive:
            self._open[session.id] -= 1
            self._open += Counter()
