"""Signals that end a run: it stops between two scans, and what it knows by then is written."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

from impslam.errors import Interrupted
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import Observer

SAID = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "terminal closed"}
"""The signals, of which Windows has not all, and how they are called."""


class Interruption(Observer):
    """Ends a run where a signal asks for it: the first one after the scan at work, the second at once.

    The first one ends it at once, too, if nothing is mapped yet. It takes signals while it is entered.

    Parameters
    ----------
    tell : called where the run ends after a scan
    """

    def __init__(self, tell: Callable[[], None] = lambda: None) -> None:
        self._tell, self._mapped, self._asked = tell, False, 0

    def __enter__(self) -> Interruption:
        """Take the signals that are not ignored (`nohup`)."""
        wanted = [getattr(signal, name) for name in SAID if hasattr(signal, name)]
        heard = [one for one in wanted if signal.getsignal(one) is not signal.SIG_IGN]
        self._before = {one: signal.signal(one, self._on_signal) for one in heard}
        return self

    def __exit__(self, *_: object) -> None:
        """Give them back."""
        for one, handler in self._before.items():
            signal.signal(one, handler)

    def follow(self, track: Track, path: PathRows) -> None:
        """End the run if that is asked for."""
        del track, path
        self._mapped = True
        self.check()

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """End the run if that is asked for."""
        del keyframe, revision, path
        self._mapped = True
        self.check()

    def check(self, *_: object) -> None:
        """Raise `Interrupted` if a signal has come."""
        if self._asked:
            self._tell()
            raise _interrupted(self._asked)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self._asked or not self._mapped:
            raise _interrupted(number)
        self._asked = number


def _interrupted(number: int) -> Interrupted:
    return Interrupted(SAID[signal.Signals(number).name], 128 + number)
