"""A fake robot in a process of its own, and a browser that opens its page."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright
from tests.platform.console.pilot import FLAGS

FAKE = Path(__file__).with_name("fake_station.py")
PATIENCE = 20.0  # s, for a loaded machine


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Robot:
    """The process of the fake robot."""

    def __init__(self, *flags: str) -> None:
        port = free_port()
        self.address = f"http://127.0.0.1:{port}"
        command = [sys.executable, str(FAKE), "--port", str(port), *flags]
        self._process = subprocess.Popen(command, cwd=FAKE.parents[3])
        try:
            until(self._answers)
        except BaseException:
            self.end()
            raise

    def ask(self, path: str) -> Any:
        with urllib.request.urlopen(f"{self.address}/fake/{path}", timeout=5) as answer:
            return json.load(answer)

    def state(self) -> dict[str, Any]:
        return dict(self.ask("state"))

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Hang as if the robot were out of reach: no connection is closed, nothing answers."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def end(self) -> None:
        if self._process.poll() is None:
            self._process.terminate()
        self._process.wait(10)

    def _answers(self) -> bool:
        assert self._process.poll() is None, "the fake robot ended; what it printed tells why"
        try:
            return bool(self.state())
        except (urllib.error.URLError, ConnectionError, TimeoutError):
            return False


class Watched:
    """An open page, with its requests and errors."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.frames: list[str] = []
        page.on("console", self._on_console)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", self._on_socket)

    def _on_console(self, message: Any) -> None:
        if message.type in {"error", "warning"}:
            self.complaints.append(message.text)

    def _on_socket(self, opened: Any) -> None:
        self.requests.append(opened.url)
        opened.on("framereceived", lambda data: self.frames.append(str(data)))


@contextmanager
def robot(*flags: str) -> Iterator[Robot]:
    made = Robot(*flags)
    try:
        yield made
    finally:
        made.end()


@contextmanager
def browser(chromium: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield made
        made.close()


@contextmanager
def visit(browser: Browser, robot: Robot, who: str = "driver", **context: Any) -> Iterator[Watched]:
    """Open the page as "driver", "second" or "watcher"."""
    context.setdefault("viewport", {"width": 1440, "height": 900})
    opened = browser.new_context(**context)
    opened.set_default_timeout(1000 * PATIENCE)
    opened.add_cookies([{"name": "as", "value": who, "url": robot.address}])
    watched = Watched(opened.new_page())
    watched.page.goto(robot.address)
    watched.page.wait_for_function("window.impLink?.beat > 0")
    try:
        yield watched
    finally:
        opened.close()


def until(holds: Callable[[], object], patience: float = PATIENCE) -> None:
    """Wait until something holds."""
    end = time.monotonic() + patience
    while not holds():
        assert time.monotonic() < end, "it never came to hold"
        time.sleep(0.05)
