"""What a service tells systemd while it runs: that it is ready, that it lives, and that it ends.

The notification protocol of sd_notify(3) is a datagram of `NAME=value` lines to a Unix socket: the
fifteen lines here are less than a dependency (the package sdnotify is an unmaintained sdist).
"""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Callable
from typing import Self

log = logging.getLogger(__name__)
STATUS = 10.0  # s between signs of life where systemd sets no watchdog


def notify(*lines: str) -> bool:
    """Tell systemd something, as in `notify("READY=1", "STATUS=maps")`; False if it does not listen.

    Never raises and never waits: a robot does not stop because nobody listens to it.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]  # an abstract socket, which is in no folder
    # A line end in a value would begin another assignment.
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
    """Tells systemd that the robot is ready, that it lives as long as it does, and that it ends.

    A context manager. When `alive` says no (or fails), the signs of life stay out and systemd ends
    the process and starts it anew. Without systemd it does nothing.

    Parameters
    ----------
    alive : whether everything that matters still runs; called from a thread of its own
    status : a line for `systemctl status`
    """

    def __init__(self, alive: Callable[[], bool], status: Callable[[], str] = lambda: "") -> None:
        self._alive, self._status = alive, status
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="watchdog", daemon=True)

    def __enter__(self) -> Self:
        """Tell that it is ready, and go on telling that it lives."""
        if notify("READY=1"):
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Tell that it ends."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(1.0)
        notify("STOPPING=1")

    def _keep(self) -> None:
        period = watchdog_period()
        while True:
            try:
                if self._alive():
                    notify("WATCHDOG=1", *self._told())
                else:
                    log.error("the robot does not live any more; systemd is to start it anew")
            except Exception:  # whatever cannot tell that it lives does not
                log.exception("the watchdog cannot tell whether the robot lives")
            if self._closing.wait(period):
                return

    def _told(self) -> list[str]:
        status = self._status()
        return [f"STATUS={status}"] if status else []


def watchdog_period() -> float:
    """Return the time between signs of life, in s: half of what systemd allows this process."""
    text, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not text.isdecimal() or int(text) == 0 or process not in {"", str(os.getpid())}:
        return STATUS
    return 0.5e-6 * int(text)
