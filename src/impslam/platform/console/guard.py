"""The guard: the outermost middleware, which checks every request and socket.

It checks the size, the host (against DNS rebinding: a foreign name that resolves to the robot's
address), the origin (else any page in the same browser could use the robot), and the session, which
the app finds as `request.state.session`.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections.abc import Callable, Iterable
from functools import partial

from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from impslam.platform.console.admission import Admission, Sockets
from impslam.platform.console.authenticator import Authenticator
from impslam.platform.console.connection import (
    SessionEnded,
    SocketConnection,
    read_body,
    while_alive,
    with_body,
)
from impslam.platform.console.messages import check_opening
from impslam.platform.console.page_limits import make_room
from impslam.platform.console.request import IncomingRequest, Refusal
from impslam.platform.console.request_checks import check_host, check_origin, check_shape
from impslam.platform.console.routes import PAGE, check_route
from impslam.platform.console.security_headers import SecurityHeaders
from impslam.platform.console.session import Session

MAX_BODY = 64 * 1024  # bytes of the body of a request, or of a socket message
MAX_LOGIN_BODY = 4 * 1024  # bytes, without a session
BODY_TIMEOUT = 10.0  # s for the whole body; a link below 64 kbit/s is too slow to drive anyway
GRACE = 1.0  # s for a socket to close
CHECK_INTERVAL = 0.25  # s between checks of an open socket's session

BUSY = Refusal(503, "too many requests at once")

_FORWARDED = re.compile(rb"x-forwarded-.*|forwarded|x-real-ip|x-original-.*")


class Guard:
    """Middleware (pure ASGI, outermost) that refuses and logs invalid requests.

    Parameters
    ----------
    app : the guarded app
    authenticator : holds the sessions
    names : host names of this server, in addition to its address
    clock : monotonic time, s
    """

    def __init__(
        self,
        app: ASGIApp,
        authenticator: Authenticator,
        names: Iterable[str],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.app, self._authenticator, self._clock = app, authenticator, clock
        self._names = frozenset(name.lower().rstrip(".") for name in names)
        self._refusals = authenticator.refusals
        self._admission, self._sockets = Admission(), Sockets()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check one request or socket, and pass it to the app or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        request = IncomingRequest(scope)
        send = SecurityHeaders(request, send)
        refusal = check_shape(request) or check_host(request, self._names) or check_origin(request)
        session = None if refusal else await self._find_session(request)
        if refusal is None and session is None and not request.public:
            refusal = Refusal(401, "no session", f"{request.method} {request.path}")
        refusal = refusal or check_route(request)
        if refusal is None and session is not None and request.socket:
            refusal = check_opening(request, session)
        if refusal is not None:
            await self._refuse(request, refusal, receive, send)
            return
        scope = _forwarded_scope(scope, session)
        if session is None or not request.socket:
            await self._handle_request(request, session, scope, receive, send)
        elif self._sockets.take(session):
            try:
                await self._handle_socket(request, session, scope, receive, send)
            finally:
                self._sockets.leave(session)
        else:
            await self._refuse(request, Refusal(503, "too many sockets"), receive, send)

    async def _find_session(self, request: IncomingRequest) -> Session | None:
        token = request.cookie(self._authenticator.cookie)
        session = self._authenticator.sessions.find(token) if token else None
        if session is not None:
            session.use()
        elif request.by_script and (header := request.header("authorization")):
            session = await self._authenticator.basic(request.address, header)
        return session

    async def _refuse(
        self, request: IncomingRequest, why: Refusal, receive: Receive, send: Send
    ) -> None:
        detail = why.detail or f"{request.method} {request.path}"
        if why.status == 401 and request.cookie(self._authenticator.cookie):
            why = Refusal(401, "a session that has ended", detail)
        self._refusals.record(request.address, why.what, detail)
        response = _answer(request, why)
        response.headers["connection"] = "close"  # the rest of the body is not read
        await response(request.scope, receive, send)

    async def _handle_request(
        self,
        request: IncomingRequest,
        session: Session | None,
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        limit = MAX_BODY if session is not None else MAX_LOGIN_BODY
        try:
            async with asyncio.timeout(BODY_TIMEOUT):
                body = await read_body(request, receive, limit)
        except TimeoutError:
            body = Refusal(408, "a slow body")
        if isinstance(body, Refusal):
            await self._refuse(request, body, receive, send)
            return
        if body is None:
            return
        turn = await self._admission.turn(request, session)
        if turn is None:
            await self._refuse(request, BUSY, receive, send)
            return
        try:
            if session is not None and request.path == PAGE and not make_room(session):
                await self._refuse(request, Refusal(503, "too many pages"), receive, send)
                return
            sent = turn.ended_by(while_alive(session, send))
            await self.app(scope, with_body(body, receive), sent)
        except SessionEnded:
            self._refusals.record(request.address, "the rest after its session ended", request.path)
        finally:
            turn.end()

    async def _handle_socket(
        self, request: IncomingRequest, session: Session, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Forward messages while the session is alive, then close the socket."""
        turn = await self._admission.turn(request, session)
        if turn is None:
            await self._refuse(request, BUSY, receive, send)
            return
        record = partial(self._refusals.record, request.address)
        connection = SocketConnection(session, receive, turn.ended_by(send), record, self._clock)
        app = asyncio.ensure_future(self.app(scope, connection.receive, connection.send))
        try:
            while not app.done():
                if why := connection.problem():
                    self._refusals.record(request.address, why, request.path)
                    with contextlib.suppress(TimeoutError):  # the browser may not read
                        await asyncio.wait_for(connection.cut(), GRACE)
                    await asyncio.wait({app}, timeout=GRACE)
                    break
                await asyncio.wait({app}, timeout=CHECK_INTERVAL)
        finally:
            turn.end()
            if not app.done():
                app.cancel()
        if connection.broken:
            self._refusals.record(request.address, "a socket message that is odd, or too large")
        if app.done() and not app.cancelled():
            app.result()


def _answer(request: IncomingRequest, why: Refusal) -> Response:
    """Return the answer to a refused request."""
    if why.status != 401:
        headers = {"retry-after": "1"} if why.status == 503 else None
        return PlainTextResponse(f"{why.what}\n", why.status, headers)
    if request.socket:
        return PlainTextResponse(f"{why.what}\n", 403)
    if "text/html" in request.header("accept"):
        return RedirectResponse("/login", 303)
    response = PlainTextResponse(f"{why.what}\n", 401)
    if request.by_script and not request.header("sec-fetch-mode"):  # browsers have the login page
        response.headers["www-authenticate"] = 'Basic realm="logs", charset="UTF-8"'
    return response


def _forwarded_scope(scope: Scope, session: Session | None) -> Scope:
    """Return the scope for the app: with the session, and without headers of proxies."""
    headers = [(name, value) for name, value in scope["headers"] if not _FORWARDED.fullmatch(name)]
    state = {**scope.get("state", {}), "session": session}
    return {**scope, "headers": headers, "state": state}
