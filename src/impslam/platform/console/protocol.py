"""Limits of connections before there is a request: their number, and the time for a head.

The guard only sees requests. A client that opens connections and sends nothing, or a header a minute,
is only seen here, and could keep everyone out, since the number of connections is limited.
"""

from __future__ import annotations

import asyncio

import h11
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from impslam.platform.console.refusals import Refusals

HEAD_TIMEOUT = 10.0  # s for the head of a request, from its first byte or from the connection
MAX_CONNECTIONS = 256  # in total, with sockets and downloads; each costs some 50 kB
MAX_PER_ADDRESS = 48  # a browser holds 6 and a socket per page; people may share an address


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 with a timeout of heads, and limits of connections in total and by address."""

    refusals: Refusals

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, object],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._timer: asyncio.TimerHandle | None = None
        self._silent = True

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, unless there are too many."""
        super().connection_made(transport)
        others = [getattr(other, "client", None) for other in self.connections]
        mine = sum(other is not None and other[0] == self._address() for other in others)
        if mine > MAX_PER_ADDRESS or len(others) > MAX_CONNECTIONS:
            self._record("too many connections")
            transport.abort()
        else:
            self._timer = self.loop.call_later(HEAD_TIMEOUT, self._on_timeout)

    def data_received(self, data: bytes) -> None:
        """Process bytes; the timer runs while a head is incomplete."""
        self._silent = False
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._cancel_timer()
        elif self._timer is None:
            self._timer = self.loop.call_later(HEAD_TIMEOUT, self._on_timeout)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._cancel_timer()
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Refuse a request that is not HTTP, or has too large a head."""
        self._record("a request that is none, or too large")
        super().send_400_response(msg)

    def _address(self) -> str:
        return self.client[0] if self.client else "unknown"

    def _record(self, what: str) -> None:
        self.refusals.record(self._address(), what)

    def _on_timeout(self) -> None:
        self._timer = None
        if not self._silent:  # browsers open connections in advance, and may not use them
            self._record("a slow request")
        self.transport.abort()

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def protocol(refusals: Refusals) -> type[LimitedProtocol]:
    """Return the protocol of a server that records what it refuses in `refusals`."""
    return type("Protocol", (LimitedProtocol,), {"refusals": refusals})
