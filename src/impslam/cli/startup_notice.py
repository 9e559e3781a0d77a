"""A notice on the terminal while a command starts and has no other output yet."""

from __future__ import annotations

import sys
import threading
import time

DELAY, INTERVAL = 0.5, 0.5
"""Time until the notice is first shown, and between updates, s. Most commands print something sooner."""
COMPILE_HINT_DELAY = 5.0
"""Time after which the notice mentions compilation, s: nothing else takes so long."""
CLEAR = "\r\x1b[K"
"""Clears the current line of a terminal."""


class StartupNotice:
    """Shows on stderr how long a command has been starting.

    Call `end` before any other output.
    """

    def __init__(self, command: str) -> None:
        self._command, self._begin = command, time.monotonic()
        self._ended, self._lock = threading.Event(), threading.Lock()
        self._shown = False

    def start(self) -> None:
        """Start to update the notice in a thread."""
        threading.Thread(target=self._update, name="startup-notice", daemon=True).start()

    def end(self) -> None:
        """Clear the line and show no more notices."""
        with self._lock:
            if self._shown:
                sys.stderr.write(CLEAR)
                sys.stderr.flush()
            self._shown = False
            self._ended.set()

    def _update(self) -> None:
        pause = DELAY
        while not self._ended.wait(pause):
            pause, seconds = INTERVAL, time.monotonic() - self._begin
            hint = seconds > COMPILE_HINT_DELAY
            why = "; the first run compiles for a minute or two" if hint else ""
            with self._lock:
                if not self._ended.is_set():
                    sys.stderr.write(f"{CLEAR}imp {self._command}: starting, {seconds:.0f} s{why}")
                    sys.stderr.flush()
                    self._shown = True


_notices: list[StartupNotice] = []
INTERACTIVE = frozenset({"robot"})
"""Commands that may prompt for input, on the line that the notice would use."""


def begin(words: list[str]) -> None:
    """Show a notice until the first output of a command, if stderr is a terminal."""
    command, *options = words or ["--help"]
    silent = command.startswith("-") or command in INTERACTIVE or "--quiet" in options
    if not silent and sys.stderr.isatty():
        _notices.append(StartupNotice(command))
        _notices[0].start()


def end() -> None:
    """Remove the notice, before other output."""
    while _notices:
        _notices.pop().end()
