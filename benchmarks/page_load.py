"""The robot's page under load from clients that may not drive, and its effect on the driver's page.

    python benchmarks/page_load.py [--seconds 10] [--rate 100] [--only NAME ...]

A server with a fake robot runs in one process, the driver's page in another one, and this one sends
requests and messages to 127.0.0.1 only. For each kind of load it prints the longest gap between two beats
at the driver's page (they are sent every 0.2 s), the longest CPU time of the server's thread between two
turns (independent of other load on the computer), the growth of the server's memory until `SETTLE` s after
the load, its CPU time, its log, and the answers to the load.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import http.client
import itertools
import json
import logging
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlencode

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

DRIVE, WATCH = "drive-password", "watch-password"
WORKERS = 8  # connections over which a load is sent
SETTLE = 5.0  # s after a load until the memory is measured: pages that were never opened are gone
SOCKET = "/_nicegui_ws/socket.io/"
TICK = os.sysconf("SC_CLK_TCK")


def serve(folder: Path) -> None:
    """Serve the page of a fake robot until SIGTERM."""
    from tests.platform.console.fake_station import FakeStation  # noqa: PLC0415  # the child alone

    from impslam.platform.console import page  # noqa: PLC0415
    from impslam.platform.console.accounts import Accounts  # noqa: PLC0415
    from impslam.platform.console.model import Model  # noqa: PLC0415
    from impslam.platform.console.server import ServerSettings, listening, prepared  # noqa: PLC0415

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    logging.getLogger("httpx").setLevel(logging.WARNING)
    accounts = Accounts(folder / "accounts.json")
    accounts.set("drive", DRIVE)
    accounts.set("watch", WATCH)
    station = FakeStation(folder, tour=True)
    station.start()
    settings = ServerSettings(port=0, accounts=accounts.path)
    with listening(settings) as listener:
        model = Model("IMP", station.view, station)
        told = lambda line: print(line, flush=True)  # noqa: E731
        server = prepared(model, settings, listener, told, page.build)
        server.beat = Stretch(folder / "stretch.txt").beat
        server.run([listener])


class Stretch:
    """Measures the longest CPU time of the server's thread between two turns.

    Unlike the gap between beats it does not depend on what else the computer does.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.task, self.longest = path, None, 0.0

    def beat(self) -> None:
        if self.task is None:
            self.task = asyncio.ensure_future(self._watch())
        new = self.path.with_suffix(".new")
        new.write_text(str(self.longest))
        new.replace(self.path)
        if self.path.with_suffix(".reset").exists():
            self.path.with_suffix(".reset").unlink()
            self.longest = 0.0

    async def _watch(self) -> None:
        while True:
            begun = time.thread_time()
            await asyncio.sleep(0.002)
            self.longest = max(self.longest, time.thread_time() - begun)


class Browser:
    """One connection with a session of its own."""

    def __init__(self, port: int, password: str = "") -> None:
        self.port, self.cookie = port, ""
        self.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        if password:
            status, headers, _ = self.ask("POST", "/login", urlencode({"password": password}))
            assert status == 303, status
            self.cookie = headers["set-cookie"].partition(";")[0]

    def ask(
        self, method: str, path: str, body: str = ""
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        headers = {"origin": f"http://127.0.0.1:{self.port}", "accept-encoding": "gzip"}
        if self.cookie:
            headers["cookie"] = self.cookie
        try:
            self.connection.request(method, path, body or None, headers)
            answer = self.connection.getresponse()
            return answer.status, answer.headers, answer.read()
        except (OSError, http.client.HTTPException):
            self.connection.close()
            raise

    def page(self) -> str:
        """Open the page; return its id."""
        self.connection.request("GET", "/", headers={"cookie": self.cookie})
        text = self.connection.getresponse().read().decode()
        found = re.search(r"'client_id': '([0-9a-f-]+)'", text)
        assert found is not None, text[:200]
        return found[1]

    @contextlib.contextmanager
    def socket(self, page: str) -> Iterator[ClientConnection]:
        query = {
            "EIO": "4", "transport": "websocket", "client_id": page, "implicit_handshake": "true",
            "tab_id": page, "document_id": page, "next_message_id": "0",
        }  # fmt: skip
        address = f"ws://127.0.0.1:{self.port}{SOCKET}?{urlencode(query)}"
        headers = {"cookie": self.cookie}
        origin = f"http://127.0.0.1:{self.port}"
        with connect(
            address, origin=origin, additional_headers=headers, proxy=None, close_timeout=1
        ) as line:
            line.recv(timeout=60)
            line.send("40")
            yield line


def drive(port: int, beats: multiprocessing.Queue) -> None:
    """Act as the driver's page: report the times of beats, and draw the map."""
    browser = Browser(port, DRIVE)
    page = browser.page()
    with browser.socket(page) as line:
        for message in line:
            if message == "2":
                line.send("3")
            elif "beat" in message[:80]:
                beats.put(time.monotonic())


class Load:
    """Sends the requests of a function at a rate, over a few connections, and counts the answers."""

    def __init__(self, send: Callable[[Browser, int], object], password: str, rate: float) -> None:
        self.send, self.password, self.rate = send, password, rate
        self.answers: Counter[object] = Counter()
        self._numbers = itertools.count()

    def run(self, port: int, seconds: float) -> None:
        self._end = time.monotonic() + seconds
        self._begun = time.monotonic()
        shared = Browser(port, self.password)
        threads = [
            threading.Thread(target=self._work, args=(port, shared.cookie)) for _ in range(WORKERS)
        ]
        for one in threads:
            one.start()
        for one in threads:
            one.join()
        if isinstance(self.send, Messages):
            self.send.open.close()

    def _work(self, port: int, cookie: str) -> None:
        browser = Browser(port)
        browser.cookie = cookie
        while time.monotonic() < self._end:
            number = next(self._numbers)
            pause = self._begun + number / self.rate - time.monotonic()
            time.sleep(max(pause, 0.0))
            try:
                self.answers[self.send(browser, number)] += 1
            except (OSError, http.client.HTTPException, WebSocketException) as error:
                self.answers[type(error).__name__] += 1


def post_a_style_sheet(browser: Browser, _: int) -> object:
    return browser.ask("POST", "/login.css")[0]


def open_pages(browser: Browser, _: int) -> object:
    return browser.ask("GET", "/")[0]


def unknown_paths(browser: Browser, number: int) -> object:
    return browser.ask("GET", f"/nothing-{number}")[0]


def scripts(browser: Browser, _: int) -> object:
    from nicegui import __version__  # noqa: PLC0415

    return browser.ask("GET", f"/_nicegui/{__version__}/static/quasar.umd.prod.js")[0]


def logins(browser: Browser, _: int) -> object:
    return browser.ask("POST", "/login", urlencode({"password": WATCH}))[0]


def sockets(browser: Browser, _: int) -> object:
    with browser.socket("none"):
        return "opened"


class Messages:
    """Sends messages on one socket per connection, each for its own page."""

    def __init__(self, *messages: tuple[str, object]) -> None:
        self.messages = messages
        self.lines: dict[int, tuple[ClientConnection, str]] = {}
        self.open = contextlib.ExitStack()
        self.lock = threading.Lock()

    def __call__(self, browser: Browser, number: int) -> object:
        me = threading.get_ident()
        if me not in self.lines:
            with self.lock:
                page = browser.page()
                line = self.open.enter_context(browser.socket(page))
            threading.Thread(target=_drain, args=(line,), daemon=True).start()
            self.lines[me] = line, page
        line, page = self.lines[me]
        name, payload = self.messages[number % len(self.messages)]
        if isinstance(payload, dict):
            payload = {"client_id": page, **payload}
        line.send("42" + json.dumps([name, payload]))
        return "sent"


def _drain(line: ClientConnection) -> None:
    with contextlib.suppress(WebSocketException):
        for message in line:
            if message == "2":
                line.send("3")


FORGED = {"level": "warning", "message": "\x1b[31mimp: warning: all is well\n" + 20_000 * "x"}
ODD = (
    ("event", {"id": 4}),
    ("event", {"id": 4, "listener_id": "none", "args": ["{"]}),
    ("log", {"level": "none"}),
    ("ack", {"next_message_id": "x"}),
    ("handshake", {}),
    ("javascript_response", {}),
)
LOADS: dict[str, tuple[Callable[[], Callable[[Browser, int], object]], str]] = {
    "nothing": (lambda: lambda browser, number: time.sleep(0.1), ""),
    "POST /login.css, no login": (lambda: post_a_style_sheet, ""),
    "GET unknown paths, watcher": (lambda: unknown_paths, WATCH),
    "log messages, watcher": (lambda: Messages(("log", FORGED)), WATCH),
    "odd messages, watcher": (lambda: Messages(*ODD), WATCH),
    "GET /, watcher": (lambda: open_pages, WATCH),
    "GET a script, watcher": (lambda: scripts, WATCH),
    "sockets, watcher": (lambda: sockets, WATCH),
    "right logins, watcher": (lambda: logins, ""),
}


class Server:
    """The server in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.log, self.stretch = folder / "log.txt", folder / "stretch.txt"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, __file__, "--serve", str(folder)],
                stdout=subprocess.PIPE, stderr=log, text=True, cwd=ROOT,
            )  # fmt: skip
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline().strip().rpartition(":")[2])

    def memory(self) -> float:
        """Resident anonymous memory, MB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"RssAnon:\s+(\d+)", status)[1]) / 1e3  # type: ignore[index]

    def cpu(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICK

    def lines(self) -> tuple[int, int]:
        data = self.log.read_bytes()
        return data.count(b"\n"), len(data)


def measure(name: str, seconds: float, rate: float) -> str:
    """Put one load on a new server, and return the results."""
    make, password = LOADS[name]
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder))
        beats: multiprocessing.Queue = multiprocessing.Queue()
        driver = multiprocessing.Process(target=drive, args=(server.port, beats), daemon=True)
        try:
            driver.start()
            for _ in range(5):
                beats.get(timeout=20)
            server.stretch.with_suffix(".reset").touch()
            memory, cpu, (lines, size) = server.memory(), server.cpu(), server.lines()
            load = Load(make(), password, rate)
            begun = time.monotonic()
            load.run(server.port, seconds)
            spent = time.monotonic() - begun
            busy = (server.cpu() - cpu) / spent
            more, larger = server.lines()
            time.sleep(SETTLE)
            seen = [beats.get() for _ in range(beats.qsize())]
            gaps = [b - a for a, b in itertools.pairwise(seen)]
            growth = server.memory() - memory
            stretch = float(server.stretch.read_text())
            again = Browser(server.port)
            status, _, _ = again.ask("POST", "/login", urlencode({"password": DRIVE}))
        finally:
            driver.terminate()
            server.process.terminate()
            server.process.wait(20)
    return (
        f"{name:28} gap {max(gaps):5.2f} s  stretch {stretch:5.3f} s  memory {growth:+6.1f} MB  "
        f"CPU {100 * busy:4.0f} %  "
        f"log {(more - lines) / spent:6.1f} lines/s {(larger - size) / spent / 1e3:7.1f} kB/s  "
        f"login after {status}  {dict(load.answers)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="of each load")
    parser.add_argument("--rate", type=float, default=100.0, help="requests or messages a second")
    parser.add_argument(
        "--only", nargs="*", default=list(LOADS), choices=list(LOADS), metavar="NAME"
    )
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve)
        return
    for name in options.only:
        print(measure(name, options.seconds, options.rate), flush=True)


if __name__ == "__main__":
    main()
