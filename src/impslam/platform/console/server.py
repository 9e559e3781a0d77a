"""The server of the page: on loopback only, or with TLS and a password; always behind the guard."""

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
from impslam.platform.console.guard import MAX_BODY, Guard
from impslam.platform.console.model import Model
from impslam.platform.console.protocol import protocol
from impslam.platform.console.request_checks import MAX_HEADERS
from impslam.platform.console.tls import CertificateFiles, own_certificate

GRACE = 1  # s for open requests to end when the server stops; sockets are closed at once
KEEP_ALIVE = 15  # s that a connection stays open without a request
GARBAGE_THRESHOLDS = (700, 10, 10)
"""Python's defaults: closed pages and replaced elements are cyclic garbage. The commands of `imp` collect
far less often, which suits short runs, but would leave hundreds of MB here."""

Report = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """The address and certificate of the server.

    Attributes
    ----------
    host : address to listen on; beyond loopback, a drive password is required and TLS is always on
    port : TCP port; 0 takes any free port
    certificate, key : PEM files; without them, a certificate is made and stored beside the accounts
    accounts : file of the passwords; None is `~/.config/impslam/accounts.json`
    names : further host names of the robot, as in `robot.example.org`
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
    authenticator : passwords and sessions
    address : address of the page, as in `https://robot.local:8080`
    beat : called ten times a second while the server runs
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
        self._thresholds = gc.get_threshold()
        self.beat: Callable[[], None] = lambda: None

    def stop(self) -> None:
        """Request the end."""
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve, and report it."""
        await super().startup(sockets)
        gc.collect()
        gc.freeze()  # later collections over all objects so far would delay the page by 0.1 s
        gc.set_threshold(*GARBAGE_THRESHOLDS)
        self._ready()

    async def on_tick(self, counter: int) -> bool:
        """Check for new passwords and log counts once a second; called ten times a second."""
        self.beat()
        if counter % 10 == 0:
            self.authenticator.sweep()
        return await super().on_tick(counter)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End every session, and with it its sockets."""
        self.authenticator.refusals.close()
        self.authenticator.close()
        gc.unfreeze()
        gc.set_threshold(*self._thresholds)
        # Requests that are aborted now, after `GRACE`, are not errors.
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL + 1)
        await super().shutdown(sockets)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """End on SIGINT and SIGTERM, and let the caller clean up.

        uvicorn raises the signal again after its end, which would kill the process before the robot
        has stopped and its log is closed.
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
        self.force_exit = self.should_exit  # the second signal does not wait
        self.should_exit = True


def serve(
    model: Model,
    settings: ServerSettings,
    *,
    ready: Report = lambda line: None,
    beat: Callable[[], None] = lambda: None,
    listener: socket.socket | None = None,
) -> None:
    """Serve the page until SIGINT or SIGTERM; open sockets are closed within 2 s.

    Parameters
    ----------
    model : what the page shows
    settings : address and certificate
    ready : called with each line for the user when the page can be opened: its address, the one-time
        link if no password is set, the certificate's fingerprint
    beat : called ten times a second while the server runs, for a watchdog
    listener : socket of `listening`, if it was opened before

    Raises
    ------
    ImpError
        If it may not or cannot listen, in one line with what to do.
    """
    with listener or listening(settings) as taken:
        from impslam.platform.console.page import build  # noqa: PLC0415  # only to serve

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
    """Return the server of the page that `build` makes, for a listening socket; see `serve`."""
    local_only, accounts = allowed(settings)
    pem = _pem(settings, accounts, local_only=local_only)
    address = _address(settings, listener, secure=pem is not None, local_only=local_only)
    authenticator = Authenticator(
        accounts,
        secure=pem is not None,
        show=lambda path: ready(f"open {address}{path}"),
        clock=clock,
    )

    def report_address() -> None:
        ready(f"the page is at {address}")
        if pem is not None:
            ready(f"SHA-256 of its certificate: {pem.fingerprint()}")
        if local_only:
            authenticator.offer_link()

    names = {*hosts.LOOPBACK, *settings.names, *(() if local_only else hosts.names())}
    guard = Guard(_app(model, authenticator, build), authenticator, names, clock)
    return Server(_config(guard, authenticator, pem), authenticator, address, report_address)


def listening(settings: ServerSettings) -> socket.socket:
    """Return a listening socket.

    Raises
    ------
    ImpError
        If that is not possible, in one line with what to do.
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
        If other computers would be served and no password to drive is set.
    """
    local_only, accounts = hosts.loopback(settings.host), Accounts(settings.accounts)
    if not local_only and "drive" not in accounts.rights():
        raise ImpError(
            f"host {settings.host}: other computers need a password to drive, and none is set; set one "
            "with `imp robot password`, or serve only this computer with --host 127.0.0.1"
        )
    return local_only, accounts


def _app(model: Model, authenticator: Authenticator, build: Callable[[Model], None]) -> FastAPI:
    """Return the app with page, login and downloads, without the guard."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    program = "imp run --live" if model.station is None else "imp robot"
    app.router.routes += login.routes(authenticator, model.title, program)
    app.router.routes += downloads.routes(authenticator, model.station)
    build(model)
    core.app.middleware_stack = None  # reset after an earlier server of a test
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
    """Answer instead of nicegui, which would build a page."""
    return PlainTextResponse("not found\n", 404)


def _handshake_answered(record: logging.LogRecord) -> bool:
    """Filter uvicorn's error about each socket that was refused by an HTTP answer, as ASGI allows."""
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
        ws_max_size=MAX_BODY,
        ws_per_message_deflate=False,  # what is sent is small or a picture; saves 300 kB a socket
        h11_max_incomplete_event_size=MAX_HEADERS,
        timeout_keep_alive=KEEP_ALIVE,
        timeout_graceful_shutdown=GRACE,
        ssl_context_factory=(lambda config, default: context) if context is not None else None,
        proxy_headers=False,
        server_header=False,
        access_log=False,
        log_config=None,
        log_level="error",  # refusals are logged by `Refusals`, at a bounded rate
        lifespan="on",
    )


def _pem(
    settings: ServerSettings, accounts: Accounts, *, local_only: bool
) -> CertificateFiles | None:
    """Return the given or self-made certificate, None on loopback without a given one."""
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
    """Return the address for the user: with the first given name, else one of this computer."""
    anywhere = settings.host in {"0.0.0.0", "::"}  # noqa: S104  # compared, not listened on
    if settings.names and not local_only:
        host = settings.names[0]
    else:
        host = hosts.mdns_name() if anywhere else settings.host
    host = f"[{host}]" if ":" in host else host
    return f"{'https' if secure else 'http'}://{host}:{listener.getsockname()[1]}"


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
