"""The server of the page: loopback alone, or TLS with a password; everything behind the guard."""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI
from nicegui import core, ui
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from impslam.errors import ImpError
from impslam.platform.console import downloads, hosts, login
from impslam.platform.console.accounts import Accounts
from impslam.platform.console.authenticator import Authenticator
from impslam.platform.console.guard import BODY, Guard
from impslam.platform.console.model import Model
from impslam.platform.console.protocol import protocol
from impslam.platform.console.request_checks import HEADERS
from impslam.platform.console.tls import CertificateFiles, own_certificate

GRACE = 1  # s for open requests to end when the server stops; sockets are closed at once
IDLE = 15  # s a connection stays open without a request

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Where the page is served, and with which certificate.

    Attributes
    ----------
    host : address to listen on; beyond loopback a drive password must be set, and TLS is always on
    port : TCP port; 0 takes any that is free
    certificate, key : PEM files; without them a certificate is made, and kept beside the accounts
    accounts : file of the passwords; None is `~/.config/impslam/accounts.json`
    names : further names that the robot is reached by, as in `robot.example.org`
    """

    host: str = "127.0.0.1"
    port: int = 8080
    certificate: Path | None = None
    key: Path | None = None
    accounts: Path | None = None
    names: tuple[str, ...] = ()


class Server(uvicorn.Server):
    """The server, ready to run; `stop` ends it from any thread.

    Attributes
    ----------
    authenticator : who may
    address : where the page is, as in `https://robot.local:8080`
    beat : called ten times a second while it lives
    """

    def __init__(
        self,
        config: uvicorn.Config,
        authenticator: Authenticator,
        address: str,
        ready: Callable[[], None],
    ) -> None:
        super().__init__(config)
        self.authenticator, self.address, self._ready = authenticator, address, ready
        self.beat: Callable[[], None] = lambda: None

    def stop(self) -> None:
        """Ask it to end."""
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve, and say so."""
        await super().startup(sockets)
        gc.collect()
        gc.freeze()  # looking for garbage in all that is loaded by now would hold up the page by 0.1 s
        self._ready()

    async def on_tick(self, counter: int) -> bool:
        """Look for new passwords and write counts once a second; called ten times a second."""
        self.beat()
        if counter % 10 == 0:
            self.authenticator.sweep()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End every session, and with them every socket."""
        self.authenticator.close()
        self.authenticator.refusals.flush(everything=True)
        gc.unfreeze()
        await super().shutdown(sockets)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """End on SIGINT and SIGTERM, and leave it to the caller to put everything away.

        uvicorn raises the signal again once it has ended, and the robot would die of it before it
        stood still and closed its log.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {one: signal.signal(one, self._on_signal) for one in _SIGNALS}
        try:
            yield
        finally:
            for one, handler in before.items():
                signal.signal(one, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.should_exit:  # the second one does not wait; what it cuts off is no fault to tell
            self.force_exit = True
            logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL + 1)
        self.should_exit = True


def serve(
    model: Model,
    settings: ServerSettings,
    *,
    ready: Report = lambda line: None,
    beat: Callable[[], None] = lambda: None,
    listener: socket.socket | None = None,
) -> None:
    """Serve the page until SIGINT or SIGTERM; open sockets are cut within 2 s.

    Parameters
    ----------
    model : what the page shows
    settings : where, and with which certificate
    ready : called once with each line that a user should see when the page can be opened: its
        address, the one-time link where no password is set, the certificate's fingerprint
    beat : called ten times a second while the server lives, for a watchdog
    listener : what `listening` returned, for who has to know that it may before anything starts

    Raises
    ------
    ImpError
        Where it may not or cannot listen: one line that says what to do.
    """
    with listener or listening(settings) as taken:
        from impslam.platform.console.page import build  # noqa: PLC0415  # it imports what this one does

        server = prepared(model, settings, taken, ready, build)
        server.beat = beat
        server.run([taken])


def prepared(
    model: Model,
    settings: ServerSettings,
    listener: socket.socket,
    ready: Report,
    build: Callable[[Model], None],
    clock: Callable[[], float] = time.monotonic,
) -> Server:
    """Return the server of the page that `build` makes, for a socket that listens; see `serve`."""
    local_only, accounts = allowed(settings)
    pem = _pem(settings, accounts, local_only=local_only)
    address = _address(settings, listener, secure=pem is not None, local_only=local_only)
    authenticator = Authenticator(
        accounts,
        secure=pem is not None,
        show=lambda path: ready(f"open {address}{path}"),
        clock=clock,
    )

    def announce() -> None:
        ready(f"the page is at {address}")
        if pem is not None:
            ready(f"SHA-256 of its certificate: {pem.fingerprint()}")
        if local_only:
            authenticator.offer_link()

    names = {*hosts.LOOPBACK, *settings.names, *(() if local_only else hosts.names())}
    guard = Guard(_app(model, authenticator, build), authenticator, names, clock)
    return Server(_config(guard, authenticator, pem), authenticator, address, announce)


def listening(settings: ServerSettings) -> socket.socket:
    """Return a socket that listens.

    Raises
    ------
    ImpError
        Where that is not possible: one line that says what to do.
    """
    host, port = settings.host, settings.port
    if not 0 <= port <= 65535:  # getaddrinfo would take it modulo 65536
        raise ImpError(f"port {port}: a port is 0 to 65535; choose another with --port")
    try:
        family, *_, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        both = family == socket.AF_INET6 and host == "::"
        return socket.create_server(where[:2], family=family, backlog=128, dualstack_ipv6=both)
    except (OSError, OverflowError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ImpError(
            f"host {host} port {port}: {reason}; choose another with --host or --port"
        ) from None


def allowed(settings: ServerSettings) -> tuple[bool, Accounts]:
    """Return whether only this computer is served, and the passwords.

    Raises
    ------
    ImpError
        Where others are to be served and no password to drive is set.
    """
    local_only, accounts = hosts.loopback(settings.host), Accounts(settings.accounts)
    if not local_only and "drive" not in accounts.rights():
        raise ImpError(
            f"host {settings.host}: beyond this computer nobody is served until a password to "
            "drive is set; `imp robot password` sets one, --host 127.0.0.1 serves here alone"
        )
    return local_only, accounts


def _app(model: Model, authenticator: Authenticator, build: Callable[[Model], None]) -> FastAPI:
    """Return the page with login and downloads; the guard is not yet before it."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    app.router.routes += login.routes(authenticator, model.title)
    app.router.routes += downloads.routes(authenticator, model.station)
    build(model)
    core.app.middleware_stack = None  # a server before this one, in a test, has used it up
    core.app.user_middleware.clear()
    core.app.add_exception_handler(404, _not_found)
    ui.run_with(
        app,
        title=model.title,
        dark=True,
        tailwind=False,
        show_welcome_message=False,
        gzip_middleware_factory=None,  # costs more than the rest of a page; files are cached anyway
    )
    return app


async def _not_found(_: Request, __: Exception) -> Response:
    """Answer in place of nicegui, which would build a page to say so."""
    return PlainTextResponse("not found\n", 404)


def _handshake_answered(record: logging.LogRecord) -> bool:
    """Drop uvicorn's complaint about each socket that was refused by an HTTP answer, as ASGI allows."""
    return "without completing handshake" not in record.getMessage()


def _config(
    guard: Guard, authenticator: Authenticator, pem: CertificateFiles | None
) -> uvicorn.Config:
    context = pem.context() if pem is not None else None
    logging.getLogger("uvicorn.error").addFilter(_handshake_answered)  # refusals are logged already
    return uvicorn.Config(
        guard,
        http=protocol(authenticator.refusals),
        ws="websockets-sansio",
        ws_max_size=BODY,
        ws_per_message_deflate=False,  # what is sent is small or a picture; saves 300 kB a socket
        h11_max_incomplete_event_size=HEADERS,
        timeout_keep_alive=IDLE,
        timeout_graceful_shutdown=GRACE,
        ssl_context_factory=(lambda config, default: context) if context is not None else None,
        proxy_headers=False,
        server_header=False,
        access_log=False,
        log_config=None,
        log_level="error",  # refusals reach the log by another way, at a bounded rate
        lifespan="on",
    )


def _pem(
    settings: ServerSettings, accounts: Accounts, *, local_only: bool
) -> CertificateFiles | None:
    """Return the certificate that is given or made, None where loopback needs none."""
    if (settings.certificate is None) != (settings.key is None):
        raise ImpError("a certificate needs its key, and a key its certificate: give both")
    if settings.certificate is not None and settings.key is not None:
        return CertificateFiles(settings.certificate, settings.key)
    if local_only:
        return None
    names = (*hosts.names(), *settings.names)
    return own_certificate(accounts.path.parent, names, hosts.addresses())


def _address(
    settings: ServerSettings, listener: socket.socket, *, secure: bool, local_only: bool
) -> str:
    """Return the address to type in: the first given name, else one of this computer."""
    anywhere = settings.host in {"0.0.0.0", "::"}  # noqa: S104  # compared, not listened on
    if settings.names and not local_only:
        host = settings.names[0]
    else:
        host = f"{hosts.names()[1]}.local" if anywhere else settings.host
    host = f"[{host}]" if ":" in host else host
    return f"{'https' if secure else 'http'}://{host}:{listener.getsockname()[1]}"


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
