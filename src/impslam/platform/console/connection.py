"""What flows after a request was let in: a socket's messages, bodies, and answers of any length."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from starlette.types import Message, Receive, Send

from impslam.platform.console.messages import Inbox
from impslam.platform.console.request import IncomingRequest, Refusal
from impslam.platform.console.session import Session
from impslam.platform.console.throttle import Bucket

MESSAGES = 400  # of a socket at once; beyond, a second:
RATE, WATCHER_RATE = 200.0, 60.0  # a page sends some 20 a second, and 10 more while it drives
STUCK = 10.0  # s that a browser may take nothing; what waits for it fills the memory
UNREADABLE = frozenset({1002, 1003, 1007, 1009})  # codes of closing, RFC 6455 sec. 7.4.1


class SocketConnection:
    """One open socket: checks and counts its messages, and can be cut from outside.

    Parameters
    ----------
    session : whose socket it is
    receive, send : the socket
    record : called with why a message is dropped
    clock : s, never stepping back
    """

    def __init__(
        self,
        session: Session,
        receive: Receive,
        send: Send,
        record: Callable[[str], None],
        clock: Callable[[], float],
    ) -> None:
        self._session, self._receive, self._send = session, receive, send
        self._record, self._clock = record, clock
        self._inbox = Inbox(session)
        self._bucket = Bucket(MESSAGES, RATE if session.may_drive else WATCHER_RATE, clock)
        self._cut = asyncio.Event()
        self._flooded = False
        self._sending: float | None = None
        self.broken = False  # whether the server closed it for what was sent

    def wrong(self) -> str:
        """Return why it has to be cut, empty where all is well."""
        if not self._session.alive():
            return "an open socket whose session has ended"
        if self._sending is not None and self._clock() - self._sending > STUCK:
            return "a socket that takes nothing"
        return "too many messages on a socket" if self._flooded else ""

    async def receive(self) -> Message:
        """Return the next message in order; once cut or wrong, that the socket is closed."""
        while True:
            message = await self._next()
            self.broken = message.get("code") in UNREADABLE
            if message["type"] != "websocket.receive":
                return message
            self._flooded = self._flooded or self._bucket.wait() > 0.0
            if self.wrong():
                await self._cut.wait()
                return {"type": "websocket.disconnect", "code": 1008}
            self._session.use()
            if why := self._inbox.refused(message.get("text")):
                self._record(why)
            else:
                return message

    async def send(self, message: Message) -> None:
        """Pass a message on, unless it comes too late."""
        if self._cut.is_set():
            return
        self._sending = self._clock()
        try:
            await self._send(message)
        finally:
            self._sending = None

    async def cut(self) -> None:
        """Close the socket, and tell the app that it is closed."""
        if not self._cut.is_set():
            self._cut.set()
            await self._send({"type": "websocket.close", "code": 1008, "reason": "refused"})

    async def _next(self) -> Message:
        message = asyncio.ensure_future(self._receive())
        cut = asyncio.ensure_future(self._cut.wait())
        try:
            await asyncio.wait({message, cut}, return_when=asyncio.FIRST_COMPLETED)
            if message.done() and not self._cut.is_set():
                return message.result()
            return {"type": "websocket.disconnect", "code": 1008}
        finally:
            message.cancel()
            cut.cancel()


class SessionEnded(OSError):
    """A session that ended while its answer was being sent."""


async def read(request: IncomingRequest, receive: Receive, limit: int) -> bytes | Refusal | None:
    """Return the whole body, None where the client has gone; it is small, so it is read first."""
    too_large = Refusal(413, "a large body", f"{request.path}: more than {limit} bytes")
    if int(request.header("content-length") or "0") > limit:  # the server saw that it is a number
        return too_large
    parts = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        parts += message.get("body", b"")
        if len(parts) > limit:
            return too_large
        if not message.get("more_body", False):
            return bytes(parts)


def replayed(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that gives the body that was read, and then what comes."""
    first = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return first.pop() if first else await receive()

    return replay


def while_alive(session: Session | None, send: Send) -> Send:
    """Return a `send` that breaks off where the session ends, and that counts as using it."""
    if session is None:
        return send

    async def checked(message: Message) -> None:
        if message["type"] == "http.response.body" and message.get("more_body"):
            if not session.alive():
                raise SessionEnded
            session.use()
        await send(message)

    return checked
