"""A word on the terminal while a command has nothing else to show yet."""

from __future__ import annotations

import sys
import threading
import time

AFTER, EVERY = 0.5, 0.5
"""s until the first word, and between two: most commands have shown something before."""
PATIENCE = 5.0
"""s after which it is told that kernels may be compiled, which nothing else takes so long for."""
CLEAR = "\r\x1b[K"
"""Empties the line of a terminal."""


class Waiting:
    """Shows on stderr, where that is a terminal, for how long a command has been starting.

    It ends with the first thing that is written elsewhere: `end` is called before it.
    """

    def __init__(self, command: str) -> None:
        self._command, self._begin = command, time.monotonic()
        self._over, self._lock = threading.Event(), threading.Lock()
        self._shown = False

    def start(self) -> None:
        """Begin to wait."""
        threading.Thread(target=self._tell, name="waiting", daemon=True).start()

    def end(self) -> None:
        """Clear the line; nothing more is shown."""
        with self._lock:
            if self._shown:
                sys.stderr.write(CLEAR)
                sys.stderr.flush()
            self._shown = False
            self._over.set()

    def _tell(self) -> None:
        pause = AFTER
        while not self._over.wait(pause):
            pause, seconds = EVERY, time.monotonic() - self._begin
            why = "; the very first run compiles, for up to a minute" if seconds > PATIENCE else ""
            with self._lock:
                if not self._over.is_set():
                    sys.stderr.write(f"{CLEAR}imp {self._command}: starting, {seconds:.0f} s{why}")
                    sys.stderr.flush()
                    self._shown = True


_waiting: list[Waiting] = []
ASKS = frozenset({"robot"})
"""Commands that may ask for something, on the line where the words would be."""


def begin(words: list[str]) -> None:
    """Begin to wait for the first output of a command, where a person looks on."""
    command, *options = words or ["--help"]
    silent = command.startswith("-") or command in ASKS or "--quiet" in options
    if not silent and sys.stderr.isatty():
        _waiting.append(Waiting(command))
        _waiting[0].start()


def end() -> None:
    """Make room for output."""
    while _waiting:
        _waiting.pop().end()
