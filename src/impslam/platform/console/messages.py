"""What a browser may send on its socket: messages for pages of its own session, well formed.

A socket speaks socket.io 5 over engine.io 4 (both protocols are specified on socket.io). nicegui
finds the page that a message is for by the id that the message carries, writes what is sent as
"log" into the robot's log, and raises on anything malformed. So each message is checked here, before
it reaches nicegui: its kind, its fields, and whether the session opened the page that it is for.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl

from nicegui import Client, json
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from impslam.platform.console.request import IncomingRequest, Refusal
from impslam.platform.console.session import Session

LONGEST = 8 * 1024  # characters; a click tells some 2000 about itself, all else is below 500
_EVENT = re.compile(r"42(?:[0-9]{1,9})?(\[.*)", re.DOTALL)
_CONNECT, _DISCONNECT, _PONG, _CLOSE = "40", "41", "3", "1"

_Short = Annotated[str, Field(max_length=64)]
_Count = Annotated[int, Field(ge=0, le=2**53, strict=False)]  # the query of a socket has it as text


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
    """What the address of a socket says; "sid" would join one that is open already."""

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


def opening(request: IncomingRequest, session: Session) -> Refusal | None:
    """Refuse a socket whose address is malformed, or that is for a page of another session."""
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
    return None if _own(query.client_id, session) else Refusal(403, "a socket for another's page")


class Inbox:
    """Checks the messages of one socket, in their order."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._connected = False

    def refused(self, text: str | None) -> str:
        """Return why a message goes no further, "" if it does; None stands for a binary one."""
        if text == _CONNECT and not self._connected:
            self._connected = True
            return ""
        if text in {_DISCONNECT, _PONG, _CLOSE}:
            return ""
        event = _EVENT.fullmatch(text) if text is not None and len(text) <= LONGEST else None
        return self._event(event[1]) if event else "a malformed message"

    def _event(self, text: str) -> str:
        try:
            kind, payload = json.loads(text)
            model = _KINDS.get(kind)
            if model is None:
                return "a message of another kind than the page sends"
            message = model.model_validate(payload)
            if isinstance(message, _Event):
                for argument in message.args:
                    json.loads(argument or "null")
        except (ValueError, TypeError):  # ValidationError and what the parser raises are both
            return "a malformed message"
        if not _own(message.client_id, self._session):
            return "a message for another's page"
        if isinstance(message, _Event) and not _heard(message):
            return "an event that nothing on the page listens to"
        return ""


def _own(page: str, session: Session) -> bool:
    """Whether a page was opened in this session; one that is gone harms nobody."""
    client = Client.instances.get(page)
    return client is None or getattr(client.request.state, "session", None) is session


def _heard(event: _Event) -> bool:
    """Whether an element listens; one that is gone is ignored by nicegui, a listener raises."""
    client = Client.instances.get(event.client_id)
    element: Any = client.elements.get(event.id) if client is not None else None
    return element is None or event.listener_id in element._event_listeners
