"""Stops a command on a signal without an exception in the middle of native code.

This module imports nothing slow, because a signal may arrive while a command starts.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from impslam.errors import Interrupted

REASONS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminal closed"}
"""The signals that stop a command (Windows lacks some), and the reason to report."""


class Interruption:
    """Stops a run: the first signal at the next `check`, the second at once. A context manager.

    An exception in a callback of numba's compiler is lost or ends the process, so the first signal is
    only remembered. `check` is called between the stages before mapping, and between scans.
    """

    def __init__(self) -> None:
        self.on_stop: Callable[[], None] = lambda: None
        self._received = 0

    def __enter__(self) -> Interruption:
        """Handle the signals."""
        self._handling = _handling(self._on_signal)
        self._handling.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers."""
        self._handling.__exit__(None, None, None)

    def check(self, *_: object) -> None:
        """Raise `Interrupted` after calling `on_stop`, if a signal was received."""
        if self._received:
            self.on_stop()
            raise _interrupted(self._received)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self._received:
            _raise(number, frame)
        self._received = number


@contextmanager
def stopped_at_once() -> Iterator[None]:
    """Raise `Interrupted` on the first signal, as every command does unless it uses `Interruption`."""
    with _handling(_raise):
        yield


@contextmanager
def _handling(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle the signals that are not ignored (as with `nohup`); restore the handlers at the end."""
    available = [getattr(signal, name) for name in REASONS if hasattr(signal, name)]
    handled = [one for one in available if signal.getsignal(one) is not signal.SIG_IGN]
    previous = {one: signal.signal(one, handler) for one in handled}
    try:
        yield
    finally:
        for one, before in previous.items():
            signal.signal(one, before)


def _raise(number: int, frame: FrameType | None) -> None:
    del frame
    raise _interrupted(number)


def _interrupted(number: int) -> Interrupted:
    return Interrupted(REASONS[signal.Signals(number).name], 128 + number)
