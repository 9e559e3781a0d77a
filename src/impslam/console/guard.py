"""The guard: stands before the whole app, and lets nothing through that it has not looked at.

Every request and every socket is asked for its size, the host it believes to talk to (else a name
that is bound to the robot's address would make it a page of its own: DNS rebinding), the page it
comes from (else any page in the same browser could use the robot), and its session. What passes
carries the session as `request.state.session`.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from http.cookies import CookieError
from typing import Final

from starlette.requests import cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from impslam.console import login
from impslam.console.gate import Gate
from impslam.console.session import Session
from impslam.console.throttle import Bucket

TARGET = 4096  # bytes of path and query; the page's longest is below 300
HEADERS = 16 * 1024  # bytes of all headers; browsers send below 2 kB
BODY = 64 * 1024  # bytes of a request's body, and of a socket's message
LOGIN_BODY = 4 * 1024  # bytes, from those who have no session yet
BODY_TIME = 10.0  # s for the whole body: below 64 kbit/s no page can be driven from anyway
MESSAGES, RATE = 400, 200.0  # of a socket, at once and a second; a page sends some 30 a second
GRACE = 1.0  # s for a socket that is cut to take note
LOOK = 0.25  # s between two looks whether an open socket's session still holds
UNREADABLE = frozenset({1002, 1003, 1007, 1009})  # codes of closing, RFC 6455 sec. 7.4.1
METHODS = frozenset({"GET", "HEAD", "POST"})
FILES = ("/logs", "/maps")  # what scripts may fetch with user and password, without a session

PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' {socket}; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"same-origin",  # not `no-referrer`: a form would then send no origin
    b"permissions-policy": b"camera=(), geolocation=(), microphone=()",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
}
_CLAIMS = re.compile(rb"x-forwarded-.*|forwarded|x-real-ip|x-original-.*")
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(?::[0-9]{1,5})?", re.IGNORECASE)
_ODD = re.compile(r"[\x00-\x1f\x7f\\]|(?:^|/)\.\.?(?:/|$)")
_HIDDEN = re.compile(rb"%(?:2f|5c|00)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request goes no further: the status it gets, and what the log is told."""

    status: int
    what: str
    detail: str = ""


class Asked:
    """One request or socket, as it presents itself."""

    def __init__(self, scope: Scope) -> None:
        self.scope = scope
        self.socket: bool = scope["type"] == "websocket"
        self.method: str = "GET" if self.socket else scope["method"]
        self.path: str = scope["path"]
        self.target: bytes = scope.get("raw_path", b"") + b"?" + scope.get("query_string", b"")
        client = scope.get("client")
        self.address: str = client[0] if client else "unknown"

    def headers(self, name: str) -> list[str]:
        """Return the values of a header, in order."""
        key = name.encode()
        return [value.decode("latin-1") for header, value in self.scope["headers"] if header == key]

    def header(self, name: str) -> str:
        """Return a header's value, empty where it is missing."""
        return next(iter(self.headers(name)), "")

    @property
    def size(self) -> int:
        """Bytes of all headers."""
        return sum(len(name) + len(value) for name, value in self.scope["headers"])

    @property
    def origin(self) -> str:
        """The origin that a page of this server has."""
        scheme = "https" if self.scope["scheme"] in {"https", "wss"} else "http"
        return f"{scheme}://{self.header('host')}".lower()

    @property
    def changes(self) -> bool:
        """Whether it may change something: a socket, or anything but GET and HEAD."""
        return self.socket or self.method not in {"GET", "HEAD"}

    @property
    def public(self) -> bool:
        """Whether it is served to those who have no session."""
        return not self.socket and self.path in login.PATHS

    @property
    def by_script(self) -> bool:
        """Whether user and password may stand in for a session."""
        files = any(self.path == top or self.path.startswith(f"{top}/") for top in FILES)
        return files and not self.changes


class Guard:
    """Middleware (pure ASGI, outermost) that refuses what is not in order, and tells the log.

    Parameters
    ----------
    app : what is guarded
    gate : knows the sessions
    names : host names that this server is reached by, beside the address it is reached at
    clock : s, never stepping back
    """

    def __init__(
        self,
        app: ASGIApp,
        gate: Gate,
        names: Iterable[str],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.app, self._gate, self._clock = app, gate, clock
        self._names = frozenset(name.lower().rstrip(".") for name in names)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Look at one request or socket, and pass it on or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        asked = Asked(scope)
        send = _Sealed(asked, send)
        refusal = _shape(asked) or self._host(asked) or _origin(asked)
        session = None if refusal else await self._session(asked)
        if refusal is None and session is None and not asked.public:
            refusal = Refusal(401, "no session", f"{asked.method} {asked.path}")
        if refusal is not None:
            await self._refuse(asked, refusal, receive, send)
            return
        scope = _passed(scope, session)
        if session is not None and asked.socket:
            await self._socket(asked, session, scope, receive, send)
        else:
            await self._request(asked, session, scope, receive, send)

    def _host(self, asked: Asked) -> Refusal | None:
        """Refuse who believes to talk to another host (an address cannot be bound anew)."""
        found = asked.headers("host")
        match = _HOST.fullmatch(found[0]) if len(found) == 1 else None
        if match is None:
            return Refusal(400, "no host", ", ".join(found))
        host = match[1].lower().rstrip(".").strip("[]")
        server = asked.scope.get("server")
        if host in self._names or (server and plain(host) == plain(server[0])):
            return None
        return Refusal(421, "a foreign host", found[0])

    async def _session(self, asked: Asked) -> Session | None:
        token = _cookie(asked, self._gate.cookie)
        session = self._gate.sessions.find(token) if token else None
        if session is not None:
            session.use()
        elif asked.by_script and (header := asked.header("authorization")):
            session = await self._gate.basic(asked.address, header)
        return session

    async def _refuse(self, asked: Asked, why: Refusal, receive: Receive, send: Send) -> None:
        detail = why.detail or f"{asked.method} {asked.path}"
        if why.status == 401 and _cookie(asked, self._gate.cookie):
            why = Refusal(401, "a session that has ended", detail)
        self._gate.refusals.tell(asked.address, why.what, detail)
        response = _answer(asked, why)
        response.headers["connection"] = "close"  # what it goes on to send is not read
        await response(asked.scope, receive, send)

    async def _request(
        self, asked: Asked, session: Session | None, scope: Scope, receive: Receive, send: Send
    ) -> None:
        limit = BODY if session is not None else LOGIN_BODY
        try:
            async with asyncio.timeout(BODY_TIME):
                body = await _body(asked, receive, limit)
        except TimeoutError:
            body = Refusal(408, "a slow body")
        if isinstance(body, Refusal):
            await self._refuse(asked, body, receive, send)
            return
        if body is None:
            return
        try:
            await self.app(scope, _replayed(body, receive), _while(session, send))
        except _Ended:
            self._gate.refusals.tell(asked.address, "the rest after its session ended", asked.path)

    async def _socket(
        self, asked: Asked, session: Session, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Pass messages on for as long as the session holds, then close the socket."""
        line = _Line(session, receive, send, self._clock)
        app = asyncio.ensure_future(self.app(scope, line.receive, line.send))
        try:
            while not app.done():
                if why := line.wrong():
                    self._gate.refusals.tell(asked.address, why, asked.path)
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(line.cut(), GRACE)  # who reads nothing gets nothing
                    await asyncio.wait({app}, timeout=GRACE)
                    break
                await asyncio.wait({app}, timeout=LOOK)
        finally:
            if not app.done():
                app.cancel()
        if line.broken:
            self._gate.refusals.tell(asked.address, "a socket message that is odd, or too large")
        if app.done() and not app.cancelled():
            app.result()


class _Line:
    """One open socket: counts its messages, and can be cut from outside."""

    def __init__(
        self, session: Session, receive: Receive, send: Send, clock: Callable[[], float]
    ) -> None:
        self._session, self._receive, self._send = session, receive, send
        self._bucket = Bucket(MESSAGES, RATE, clock)
        self._cut = asyncio.Event()
        self._flooded = False
        self.broken = False  # whether the server closed it for what was sent

    def wrong(self) -> str:
        """Return why it has to be cut, empty where all is well."""
        if not self._session.alive():
            return "an open socket whose session has ended"
        return "too many messages on a socket" if self._flooded else ""

    async def receive(self) -> Message:
        """Return the next message; once cut or wrong, that the socket is closed."""
        message = await self._next()
        self.broken = message.get("code") in UNREADABLE
        if message["type"] != "websocket.receive":
            return message
        self._flooded = self._flooded or self._bucket.wait() > 0.0
        if self.wrong():
            await self._cut.wait()
            return {"type": "websocket.disconnect", "code": 1008}
        self._session.use()
        return message

    async def send(self, message: Message) -> None:
        """Pass a message on, unless it comes too late."""
        if not self._cut.is_set():
            await self._send(message)

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


class _Sealed:
    """Puts the headers on every answer that keep browsers from doing more than they should."""

    def __init__(self, asked: Asked, send: Send) -> None:
        self._asked, self._send = asked, send

    async def __call__(self, message: Message) -> None:
        """Pass a message on, with the headers where it has any."""
        if message["type"] in {"http.response.start", "websocket.http.response.start"}:
            message = {**message, "headers": self._headers(message.get("headers", []))}
        await self._send(message)

    def _headers(self, headers: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
        given = [(name.lower(), value) for name, value in headers]
        names = {name for name, _ in given}
        ours = dict(_HEADERS)
        if b"content-security-policy" not in names:
            ours[b"content-security-policy"] = self._policy().encode("latin-1")
        if not self._asked.path.startswith("/_nicegui/") or b"cache-control" not in names:
            ours[b"cache-control"] = b"no-store"
        kept = [
            (name, value)
            for name, value in given
            if name not in ours and not name.startswith(b"access-control-") and name != b"server"
        ]
        return [*kept, *ours.items()]

    def _policy(self) -> str:
        # 'self' does not cover sockets in older browsers; the host was looked at before.
        match = _HOST.fullmatch(self._asked.header("host"))
        socket = f"ws{self._asked.origin[4:]}" if match else ""
        return PAGE_POLICY.format(socket=socket)


class _Ended(OSError):
    """A session that ended while its answer was being sent."""


def plain(address: str) -> str:
    """Return an address in its one form, without zone; unchanged where it is none."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return str(mapped or found)


def _shape(asked: Asked) -> Refusal | None:
    """Refuse what is larger or odder than anything the page sends."""
    if len(asked.target) > TARGET:
        return Refusal(414, "a long target", f"{len(asked.target)} bytes")
    if asked.size > HEADERS:
        return Refusal(431, "large headers", f"{asked.size} bytes")
    if _ODD.search(asked.path) or _HIDDEN.search(asked.target.partition(b"?")[0]):
        return Refusal(400, "an odd path", asked.target.partition(b"?")[0].decode("latin-1"))
    if asked.method not in METHODS:
        return Refusal(405, "a method", asked.method)
    return None


def _origin(asked: Asked) -> Refusal | None:
    """Refuse what pages of others send; what changes something has to say where it comes from.

    Cookies do not tell ports apart, so that a page on another port of the same host counts as
    foreign here, whatever `SameSite` says. Only a link may lead here from anywhere.
    """
    origins, site = asked.headers("origin"), asked.header("sec-fetch-site")
    if any(origin.lower() != asked.origin for origin in origins) or len(origins) > 1:
        return Refusal(403, "a foreign origin", ", ".join(origins))
    if asked.changes and not origins:
        return Refusal(403, "no origin")
    link = asked.header("sec-fetch-mode") == "navigate" and not asked.changes
    framed = asked.header("sec-fetch-dest") in {"iframe", "frame", "embed", "object"}
    if site not in {"", "same-origin", "none"} and (framed or not link):
        return Refusal(403, "a foreign origin", site)
    return None


def _answer(asked: Asked, why: Refusal) -> Response:
    """Return what the client of a refusal gets to see."""
    if why.status != 401:
        return PlainTextResponse(f"{why.what}\n", why.status)
    if asked.socket:
        return PlainTextResponse(f"{why.what}\n", 403)
    if "text/html" in asked.header("accept"):
        return RedirectResponse("/login", 303)
    response = PlainTextResponse(f"{why.what}\n", 401)
    if asked.by_script and not asked.header("sec-fetch-mode"):  # browsers have the login page
        response.headers["www-authenticate"] = 'Basic realm="logs", charset="UTF-8"'
    return response


def _cookie(asked: Asked, name: str) -> str:
    try:
        return cookie_parser("; ".join(asked.headers("cookie"))).get(name, "")
    except CookieError:
        return ""


def _passed(scope: Scope, session: Session | None) -> Scope:
    """Return what the app sees: the session, and nothing of what proxies are said to have seen."""
    headers = [(name, value) for name, value in scope["headers"] if not _CLAIMS.fullmatch(name)]
    state = {**scope.get("state", {}), "session": session}
    return {**scope, "headers": headers, "state": state}


async def _body(asked: Asked, receive: Receive, limit: int) -> bytes | Refusal | None:
    """Return the whole body, None where the client has gone; it is small, so it is read first."""
    too_large = Refusal(413, "a large body", f"{asked.path}: more than {limit} bytes")
    if int(asked.header("content-length") or "0") > limit:  # the server saw that it is a number
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


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that gives the body that was read, and then what comes."""
    first = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return first.pop() if first else await receive()

    return replay


def _while(session: Session | None, send: Send) -> Send:
    """Return a `send` that breaks off where the session ends, and that counts as using it."""
    if session is None:
        return send

    async def checked(message: Message) -> None:
        if message["type"] == "http.response.body" and message.get("more_body"):
            if not session.alive():
                raise _Ended
            session.use()
        await send(message)

    return checked
