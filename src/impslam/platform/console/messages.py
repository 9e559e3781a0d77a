"""Check the messages of a browser's socket: well formed, and for pages of its own session.

A socket uses socket.io 5 over engine.io 4 (both protocols are specified on socket.io). nicegui finds
the page of a message by the id in the message, writes messages of kind "log" to the robot's log, and
raises on anything malformed. So each message is checked here first: its kind, its fields, and whether
the session opened its page.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl

from nicegui import Client, json
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from impslam.platform.console.request import IncomingRequest, Refusal
from impslam.platform.console.session import Session

MAX_LENGTH = 8 * 1024  # characters; a click has some 2000, all else is below 500
_EVENT = re.compile(r"42(?:[0-9]{1,9})?(\[.*)", re.DOTALL)
_CONNECT, _DISCONNECT, _PONG, _CLOSE = "40", "41", "3", "1"

_Short = Annotated[str, Field(max_length=64)]
_Count = Annotated[int, Field(ge=0, le=2**53, strict=False)]  # text in the query of a socket


class _Message(BaseModel):
    model_config = ConfigDict(strict=True)
    client_id: _Short


class _Handshake(_Message):
    tab_id: _Short
    document_id: _Short
    old_tab_id: _Short | None = None
    next_message_id: _Count = 0


class _Event(_Message):
    id: Annotated[int, Field(ge=0)]
    listener_id: _Short
    args: list[str | None] = []


class _Ack(_Message):
    next_message_id: _Count


class _Query(BaseModel):
    """The query of a socket's address; "sid" would join an open socket, and is not allowed."""

    model_config = ConfigDict(extra="forbid")
    EIO: Literal["4"]
    transport: Literal["websocket"]
    t: _Short = ""
    implicit_handshake: _Short = ""
    client_id: _Short = ""
    tab_id: _Short = ""
    document_id: _Short = ""
    old_tab_id: _Short = ""
    next_message_id: _Count = 0


_KINDS: dict[str, type[_Message]] = {"handshake": _Handshake, "event": _Event, "ack": _Ack}


def check_opening(request: IncomingRequest, session: Session) -> Refusal | None:
    """Refuse a socket with a malformed address, or for a page of another session."""
    given = parse_qsl(request.scope.get("query_string", b"").decode("latin-1"))
    fields = dict(given)
    try:
        query = _Query.model_validate(fields)
        if query.implicit_handshake == "true":
            _Handshake.model_validate(fields)
    except ValidationError:
        return Refusal(400, "a malformed socket")
    if len(fields) != len(given):
        return Refusal(400, "a malformed socket")
    if not _may_address(query.client_id, session):
        return Refusal(403, "a socket for another's page")
    return None


class MessageValidator:
    """Checks the messages of one socket, in order."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._connected = False

    def check(self, text: str | None) -> str:
        """Return why a message is refused, "" if it is not; None is a binary message."""
        if text == _CONNECT and not self._connected:
            self._connected = True
            return ""
        if text in {_DISCONNECT, _PONG, _CLOSE}:
            return ""
        event = _EVENT.fullmatch(text) if text is not None and len(text) <= MAX_LENGTH else None
        return self._check_event(event[1]) if event else "a malformed message"

    def _check_event(self, text: str) -> str:
        try:
            kind, payload = json.loads(text)
            model = _KINDS.get(kind)
            if model is None:
                return "a message of another kind than the page sends"
            message = model.model_validate(payload)
            if isinstance(message, _Event):
                for argument in message.args:
                    json.loads(argument or "null")
        except (ValueError, TypeError):  # includes ValidationError and errors of the parser
            return "a malformed message"
        if not _may_address(message.client_id, self._session):
            return "a message for another's page"
        if isinstance(message, _Event) and not _has_listener(message):
            return "an event that nothing on the page listens to"
        return ""


def _may_address(page: str, session: Session) -> bool:
    """Return whether a page was opened in this session, or does not exist any more."""
    client = Client.instances.get(page)
    return client is None or getattr(client.request.state, "session", None) is session


def _has_listener(event: _Event) -> bool:
    """Return whether the listener exists, or its element is gone: nicegui ignores only the latter."""
    client = Client.instances.get(event.client_id)
    element: Any = client.elements.get(event.id) if client is not None else None
    return element is None or event.listener_id in element._event_listeners
