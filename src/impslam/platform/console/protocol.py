"""What the server asks of a connection before there is a request: to be quick, and not one of many.

The guard sees requests. Who opens connections and says nothing, or a header a minute, is seen here
alone, and would else keep everyone out: the server has room for a limited number of connections.
"""

from __future__ import annotations

import asyncio

import h11
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from impslam.platform.console.refusals import Refusals

HEAD_TIME = 10.0  # s for a request's head, from the first byte or from the connection on
CONNECTIONS = 256  # in all: sockets and downloads included, each costs some 50 kB
PER_ADDRESS = 48  # a browser holds 6 and a socket for each page; several people behind one router


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 with a time limit for heads, and a limit of connections in all and by address."""

    refusals: Refusals

    def __init__(
        self,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, object],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._due: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, unless there are too many."""
        super().connection_made(transport)
        others = [getattr(other, "client", None) for other in self.connections]
        mine = sum(other is not None and other[0] == self._address() for other in others)
        if mine > PER_ADDRESS or len(others) > CONNECTIONS:
            self._record("too many connections")
            transport.abort()
        else:
            self._due = self.loop.call_later(HEAD_TIME, self._late)

    def data_received(self, data: bytes) -> None:
        """Take bytes; the clock runs wherever a head is not complete."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._disarm()
        elif self._due is None:
            self._due = self.loop.call_later(HEAD_TIME, self._late)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._disarm()
        super().connection_lost(exc)

    def send_400_response(self, msg: str) -> None:
        """Refuse what is no HTTP, or has too large a head."""
        self._record("a request that is none, or too large")
        super().send_400_response(msg)

    def _address(self) -> str:
        return self.client[0] if self.client else "unknown"

    def _record(self, what: str) -> None:
        self.refusals.record(self._address(), what)

    def _late(self) -> None:
        self._due = None
        self._record("a slow request")
        self.transport.abort()

    def _disarm(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None


def protocol(refusals: Refusals) -> type[LimitedProtocol]:
    """Return the protocol of a server that tells `refusals` what it refuses."""
    return type("Protocol", (LimitedProtocol,), {"refusals": refusals})
