"""Notify systemd that the service is ready, alive, or stopping.

The protocol of sd_notify(3) is a datagram of `NAME=value` lines to a Unix socket; the fifteen lines
here avoid a dependency (the package sdnotify is an unmaintained sdist).
"""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Callable
from typing import Self

log = logging.getLogger(__name__)
NOTIFY_INTERVAL = 10.0  # s between keep-alives if systemd sets no watchdog


def notify(*lines: str) -> bool:
    """Send lines to systemd, as in `notify("READY=1", "STATUS=maps")`; return whether they were sent.

    Never raises or blocks: the robot does not depend on systemd.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]  # an abstract socket
    # A newline in a value would begin another assignment.
    text = "\n".join(" ".join(line.splitlines()) for line in lines)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            link.setblocking(False)
            link.sendto(text.encode(), address)
    except OSError as error:
        log.warning("systemd cannot be notified of %r: %s", text, error)
        return False
    return True


class Watchdog:
    """Notifies systemd at the start, periodically while the robot is alive, and at the end.

    A context manager. If `alive` returns False or raises, no keep-alive is sent, and systemd restarts
    the process. Without systemd it does nothing.

    Parameters
    ----------
    alive : returns whether everything essential still runs; called from a separate thread
    status : returns a line for `systemctl status`
    """

    def __init__(self, alive: Callable[[], bool], status: Callable[[], str] = lambda: "") -> None:
        self._alive, self._status = alive, status
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)

    def __enter__(self) -> Self:
        """Report that the service is ready, and start the keep-alives."""
        if notify("READY=1"):
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Report that the service is stopping."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        notify("STOPPING=1")

    def _run(self) -> None:
        period = watchdog_period()
        while True:
            try:
                if self._alive():
                    notify("WATCHDOG=1", *self._status_lines())
                else:
                    log.error(
                        "the robot program does not respond any more; systemd will restart it"
                    )
            except Exception:  # counts as not alive
                log.exception("the watchdog cannot check whether the robot is alive")
            if self._closing.wait(period):
                return

    def _status_lines(self) -> list[str]:
        status = self._status()
        return [f"STATUS={status}"] if status else []


def watchdog_period() -> float:
    """Return the time between keep-alives, s: half of what systemd allows this process."""
    text, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not text.isdecimal() or int(text) == 0 or process not in {"", str(os.getpid())}:
        return NOTIFY_INTERVAL
    return 0.5e-6 * int(text)
