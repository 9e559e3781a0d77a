"""Each socket commands the page of its own session, and no other.

nicegui finds the page that a message is for by the id that the message carries; whoever knows the
id of another's page could press its buttons. Here the session that opened the socket must be the
one that opened the page.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import parse_qs

from nicegui import Client, core
from socketio import exceptions  # type: ignore[import-untyped]  # it has no stubs

from impslam.platform.console.refusals import Refusals
from impslam.platform.console.session import Session

EVENTS = ("handshake", "event", "javascript_response", "ack", "log")

Handler = Callable[..., Any]


def bind_to_sessions(refusals: Refusals) -> None:
    """Wrap nicegui's handlers of messages, and leave sockets as the only transport."""
    core.sio.eio.transports = ["websocket"]  # a long poll would outlive its session
    handlers: dict[str, Handler] = core.sio.handlers["/"]
    for event in EVENTS:
        handlers[event] = _bound(_inner(handlers[event]), refusals)
    handlers["connect"] = _bound_connect(_inner(handlers["connect"]), refusals)


def _bound(handler: Handler, refusals: Refusals) -> Handler:
    """Return a handler of messages that refuses those for another session's page."""

    async def bound(sid: str, message: object) -> Any:
        if not isinstance(message, dict) or not isinstance(message.get("client_id"), str):
            return _refuse(sid, refusals, "an odd message on a socket")
        if not _own(sid, message["client_id"]):
            return _refuse(sid, refusals, "a message for another's page")
        return await _result(handler(sid, message))

    bound.inner = handler  # type: ignore[attr-defined]  # so that binding anew wraps it once
    return bound


def _bound_connect(handler: Handler, refusals: Refusals) -> Handler:
    """Return a handler of new sockets that refuses those for another session's page."""

    async def bound(sid: str, environ: dict[str, Any], auth: object = None) -> Any:
        pages = parse_qs(environ.get("QUERY_STRING", "")).get("client_id", [])
        if not all(_own(sid, page) for page in pages):
            _refuse(sid, refusals, "a socket for another's page")
            raise exceptions.ConnectionRefusedError("not yours")
        return await _result(handler(sid, environ, auth))

    bound.inner = handler  # type: ignore[attr-defined]  # so that binding anew wraps it once
    return bound


def _inner(handler: Handler) -> Handler:
    return getattr(handler, "inner", handler)


def _own(sid: str, page: str) -> bool:
    """Whether a page was opened in the session of the socket; one that is gone harms nobody."""
    client = Client.instances.get(page)
    if client is None:
        return True
    session = _session(sid)
    return session is not None and getattr(client.request.state, "session", None) is session


def _session(sid: str) -> Session | None:
    scope = _scope(sid)
    session = scope.get("state", {}).get("session")
    return session if isinstance(session, Session) and session.alive() else None


def _scope(sid: str) -> dict[str, Any]:
    environ: dict[str, Any] | None = core.sio.get_environ(sid)
    found: dict[str, Any] = (environ or {}).get("asgi.scope", {})
    return found


def _refuse(sid: str, refusals: Refusals, what: str) -> None:
    client = _scope(sid).get("client")
    refusals.tell(client[0] if client else "unknown", what)


async def _result(given: Awaitable[Any] | object) -> Any:
    return await given if isinstance(given, Awaitable) else given
