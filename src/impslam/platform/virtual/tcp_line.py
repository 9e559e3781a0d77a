"""A line that is a TCP server on loopback."""

from __future__ import annotations

import socket

from impslam.errors import ImpError
from impslam.platform.virtual.line import CHUNK, Line


class TcpLine(Line):
    """A TCP server on loopback, for one host at a time."""

    def __init__(self, port: int = 0, seed: int = 0, baud: int = 0) -> None:
        super().__init__(seed, baud)
        self._host: socket.socket | None = None
        self._reserve(port)
        self._port: int = self._server.getsockname()[1]
        self._plug()

    @property
    def url(self) -> str:
        """The URL for pyserial."""
        return f"socket://127.0.0.1:{self._port}"

    def _reserve(self, port: int) -> None:
        """Bind the port without listening: connections are refused, and the port stays reserved."""
        self._server = socket.socket()
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._server.bind(("127.0.0.1", port))
        except OSError as error:
            self._server.close()
            raise ImpError(f"TCP port {port} of 127.0.0.1: {error}; choose another") from error

    def _plug(self) -> None:
        self._server.listen(1)
        self._server.setblocking(False)

    def _pull(self) -> None:
        self._hang_up()
        self._server.close()
        self._reserve(self._port)

    def close(self) -> None:
        """Remove the port permanently."""
        super().close()
        self._server.close()

    def _hang_up(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None

    def _read(self) -> bytes:
        try:
            if self._host is None:
                self._host, _ = self._server.accept()
                self._host.setblocking(False)
                self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            data = self._host.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:  # the host has hung up
            self._hang_up()
        return data

    def _write(self, data: bytes) -> int | None:
        if self._host is None:
            return None
        try:
            return self._host.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return None
