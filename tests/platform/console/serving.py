"""A server on a loopback port with a page of one button, for tests over the network."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import httpx
from fastapi import Request
from nicegui import Client, core, ui

from impslam.platform.console.accounts import Accounts, write_private
from impslam.platform.console.model import Model
from impslam.platform.console.server import Server, ServerSettings, listening, prepared
from impslam.platform.console.session import Session
from impslam.platform.station.log_store import LogStore
from impslam.platform.station.map_store import MapStore
from impslam.types import Image

DRIVE, WATCH = "drive-password", "watch-password"
CHEAP = b'{"salt": "c2FsdA==", "cost": {"blocks": 16}}'  # so that a thousand logins take no time
PICTURE = b"\xff\xd8 a picture \xff\xd9"


class Clock:
    """A monotonic clock that can be advanced."""

    def __init__(self) -> None:
        self.ahead = 0.0

    def __call__(self) -> float:
        return time.monotonic() + self.ahead


def stand_in(folder: Path) -> Model:
    """A model of a station that has logs and a picture, and no devices."""
    station = SimpleNamespace(
        store=LogStore(folder),
        maps=MapStore(folder / "maps"),
        folder=folder,
        picture=Image(0.0, "jpeg", PICTURE),
    )
    return cast(
        "Model", SimpleNamespace(title="test robot", station=station, player=None, view=None)
    )


@dataclass
class Pressed:
    """Records the presses of the page's button."""

    by: list[Session] = field(default_factory=list)

    def build(self, _: Model) -> None:
        @ui.page("/")
        def page(request: Request) -> None:
            session = request.state.session
            ui.button("go", on_click=lambda: self.by.append(session))


@dataclass
class Running:
    """A server that runs in a thread."""

    server: Server
    clock: Clock
    pressed: Pressed
    notices: list[str]
    port: int
    verify: Any = True

    @property
    def origin(self) -> str:
        scheme = "https" if self.server.authenticator.secure else "http"
        return f"{scheme}://127.0.0.1:{self.port}"

    def client(self, **options: Any) -> httpx.Client:
        """A browser without a session."""
        return httpx.Client(
            base_url=self.origin, verify=self.verify, timeout=10.0, trust_env=False, **options
        )

    def close_pages(self) -> None:
        """Delete every page, even those that nicegui would delete later."""
        done = threading.Event()

        def close() -> None:
            for page in list(Client.instances.values()):
                for task in page._delete_tasks.values():
                    task.cancel()
                page.delete()
            done.set()

        assert core.loop is not None
        core.loop.call_soon_threadsafe(close)
        assert done.wait(10.0)

    @contextlib.contextmanager
    def logged_in(self, password: str = DRIVE) -> Iterator[httpx.Client]:
        """A browser with a session."""
        with self.client() as client:
            headers = {"origin": self.origin}
            answer = client.post("/login", data={"password": password}, headers=headers)
            assert (answer.status_code, answer.headers["location"]) == (303, "/"), answer.text
            yield client


@contextlib.contextmanager
def serving(
    folder: Path,
    *,
    passwords: bool = True,
    verify: Any = True,
    build: Callable[[Model], None] | None = None,
    **settings: Any,
) -> Iterator[Running]:
    """Serve until the block ends."""
    accounts = Accounts(folder / "accounts" / "accounts.json")
    if passwords:
        write_private(accounts.path, CHEAP)
        accounts.set("drive", DRIVE)
        accounts.set("watch", WATCH)
    logs = folder / "logs"
    logs.mkdir(exist_ok=True)
    wanted = ServerSettings(port=0, accounts=accounts.path, **settings)
    clock, pressed, notices, ready = Clock(), Pressed(), [], threading.Event()

    with listening(wanted) as listener:
        server = prepared(
            stand_in(logs), wanted, listener, notices.append, build or pressed.build, clock
        )
        tell = server._ready
        server._ready = lambda: (tell(), ready.set())  # type: ignore[assignment]
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        try:
            assert ready.wait(20.0)
            port = listener.getsockname()[1]
            yield Running(server, clock, pressed, notices, port, verify)
        finally:
            server.stop()
            thread.join(10.0)
            assert not thread.is_alive()
            Client.instances.clear()  # nicegui gives its pages up in the loop that has ended


def raw(port: int, data: bytes, *, wait: float = 5.0) -> bytes:
    """Send bytes and return the answer until the other side closes."""
    with socket.create_connection(("127.0.0.1", port), timeout=wait) as connection:
        connection.sendall(data)
        answer = b""
        with contextlib.suppress(TimeoutError, ConnectionError):
            while part := connection.recv(65536):
                answer += part
        return answer
