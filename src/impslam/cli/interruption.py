"""Stops a run on a signal, between two scans, so that what has been mapped is written."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

from impslam.errors import Interrupted
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import Observer

REASONS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminal closed"}
"""The signals that stop a run (Windows lacks some), and the reason to report."""


class Interruption(Observer):
    """Stops a run on a signal: on the first one after the current scan, on the second at once.

    The first one also stops it at once if nothing is mapped yet. Use it as a context manager.

    Parameters
    ----------
    on_stop : called before the run is stopped after a scan
    """

    def __init__(self, on_stop: Callable[[], None] = lambda: None) -> None:
        self._on_stop, self._mapped, self._received = on_stop, False, 0

    def __enter__(self) -> Interruption:
        """Install handlers for the signals that are not ignored (as with `nohup`)."""
        available = [getattr(signal, name) for name in REASONS if hasattr(signal, name)]
        handled = [one for one in available if signal.getsignal(one) is not signal.SIG_IGN]
        self._previous = {one: signal.signal(one, self._on_signal) for one in handled}
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers."""
        for one, handler in self._previous.items():
            signal.signal(one, handler)

    def follow(self, track: Track, path: PathRows) -> None:
        """Stop the run if a signal was received."""
        del track, path
        self._mapped = True
        self.check()

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Stop the run if a signal was received."""
        del keyframe, revision, path
        self._mapped = True
        self.check()

    def check(self, *_: object) -> None:
        """Raise `Interrupted` if a signal was received."""
        if self._received:
            self._on_stop()
            raise _interrupted(self._received)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self._received or not self._mapped:
            raise _interrupted(number)
        self._received = number


def _interrupted(number: int) -> Interrupted:
    return Interrupted(REASONS[signal.Signals(number).name], 128 + number)
