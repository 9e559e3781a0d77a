"""Messages of sockets, bodies and long answers of accepted requests."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from starlette.types import Message, Receive, Send

from impslam.platform.console.messages import MessageValidator
from impslam.platform.console.request import IncomingRequest, Refusal
from impslam.platform.console.session import Session
from impslam.platform.console.throttle import Bucket

MESSAGE_BURST = 400  # messages of a socket at once
RATE, WATCHER_RATE = 200.0, 60.0  # 1/s; a page sends some 20 a second, and 10 more while it drives
SEND_TIMEOUT = 10.0  # s that a browser may take nothing; waiting messages fill the memory
UNREADABLE_CODES = frozenset({1002, 1003, 1007, 1009})  # close codes, RFC 6455 sec. 7.4.1


class SocketConnection:
    """One open socket; checks and counts its messages, and can be closed from outside.

    Parameters
    ----------
    session : its session
    receive, send : the socket
    record : called with the reason when a message is dropped
    clock : monotonic time, s
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
        self._inbox = MessageValidator(session)
        self._bucket = Bucket(MESSAGE_BURST, RATE if session.may_drive else WATCHER_RATE, clock)
        self._cut = asyncio.Event()
        self._flooded = False
        self._sending: float | None = None
        self.broken = False  # whether the server closed it because of an invalid message

    def problem(self) -> str:
        """Return why the socket must be closed, "" if all is well."""
        if not self._session.alive():
            return "an open socket whose session has ended"
        if self._sending is not None and self._clock() - self._sending > SEND_TIMEOUT:
            return "a socket that takes nothing"
        return "too many messages on a socket" if self._flooded else ""

    async def receive(self) -> Message:
        """Return the next valid message, or a disconnect once the socket is cut."""
        while True:
            message = await self._receive_or_cut()
            self.broken = message.get("code") in UNREADABLE_CODES
            if message["type"] != "websocket.receive":
                return message
            self._flooded = self._flooded or self._bucket.wait() > 0.0
            if self.problem():
                await self._cut.wait()
                return {"type": "websocket.disconnect", "code": 1008}
            self._session.use()
            if why := self._inbox.check(message.get("text")):
                self._record(why)
            else:
                return message

    async def send(self, message: Message) -> None:
        """Send a message, unless the socket is cut."""
        if self._cut.is_set():
            return
        self._sending = self._clock()
        try:
            await self._send(message)
        finally:
            self._sending = None

    async def cut(self) -> None:
        """Close the socket for the browser and for the app."""
        if not self._cut.is_set():
            self._cut.set()
            await self._send({"type": "websocket.close", "code": 1008, "reason": "refused"})

    async def _receive_or_cut(self) -> Message:
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
    """The session ended while its answer was being sent."""


async def read_body(
    request: IncomingRequest, receive: Receive, limit: int
) -> bytes | Refusal | None:
    """Return the whole body, a refusal if it is too large, or None if the client has gone."""
    too_large = Refusal(413, "a large body", f"{request.path}: more than {limit} bytes")
    if int(request.header("content-length") or "0") > limit:  # the server has checked the number
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


def with_body(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that gives a body that was read already, and then further messages."""
    first = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return first.pop() if first else await receive()

    return replay


def while_alive(session: Session | None, send: Send) -> Send:
    """Return a `send` that aborts when the session ends, and that counts as its use."""
    if session is None:
        return send

    async def checked(message: Message) -> None:
        if message["type"] == "http.response.body" and message.get("more_body"):
            if not session.alive():
                raise SessionEnded
            session.use()
        await send(message)

    return checked
