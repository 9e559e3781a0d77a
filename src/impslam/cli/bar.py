"""The progress of a run, as one of its observers."""

from __future__ import annotations

import time
from typing import Any

from impslam.cli.progress import PERIOD
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.sources.base import Source


class Bar(Observer):
    """Shows how far a run has come. Does nothing without a display.

    How much there is to do the source tells while it is open: during the run.
    """

    def __init__(self, source: Source, display: Any = None) -> None:
        self._source, self._display, self._due = source, display, 0.0
        self._scans, self._begin = 0, 0.0
        if display is not None:
            self._task = display.add_task("starting (the very first run compiles)", total=None)

    def follow(self, track: Track, path: PathRows) -> None:
        """Move on."""
        del track
        self._move(len(path.stamps))

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Move on."""
        del keyframe, revision
        self._move(len(path.stamps))

    def _move(self, scans: int) -> None:
        now = time.monotonic()
        self._begin = self._begin or now
        self._scans += scans
        if self._display is None or now < self._due:
            return
        self._due, seconds = now + PERIOD, now - self._begin
        rate = f", {self._scans / seconds:,.0f} scans/s" if seconds > PERIOD else ""
        self._display.update(
            self._task,
            description=f"mapping{rate}",
            total=self._source.total,
            completed=self._source.position,
        )

    def interrupted(self) -> None:
        """Say what comes after a run that was interrupted."""
        self._tell("interrupted, writing what is known (once more: stop at once)")

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Say what comes after the last scan."""
        del known
        if not outcome.partial:
            self._tell("writing the report")

    def show(self, what: str, share: float) -> None:
        """Show what is written after the run, and the share of it that is."""
        if self._display is not None:
            self._display.update(self._task, description=what, total=1.0, completed=share)

    def _tell(self, description: str) -> None:
        if self._display is not None:
            self._display.update(self._task, description=description)
