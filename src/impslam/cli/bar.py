"""An observer that shows the progress of a run."""

from __future__ import annotations

import time
from typing import Any

from impslam.cli.progress import UPDATE_INTERVAL
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.sources.base import Source


class RunBar(Observer):
    """Shows the progress of a run, or nothing if the display is None."""

    def __init__(self, source: Source, display: Any = None) -> None:
        self._source, self._display, self._due = source, display, 0.0
        self._scans, self._begin = 0, 0.0
        if display is not None:
            self._task = display.add_task("starting (the first run compiles)", total=None)

    def follow(self, track: Track, path: PathRows) -> None:
        """Advance the bar."""
        del track
        self._advance(len(path.stamps))

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Advance the bar."""
        del keyframe, revision
        self._advance(len(path.stamps))

    def _advance(self, scans: int) -> None:
        now = time.monotonic()
        self._begin = self._begin or now
        self._scans += scans
        if self._display is None or now < self._due:
            return
        self._due, seconds = now + UPDATE_INTERVAL, now - self._begin
        rate = f", {self._scans / seconds:,.0f} scans/s" if seconds > UPDATE_INTERVAL else ""
        self._display.update(
            self._task,
            description=f"mapping{rate}",
            total=self._source.total,  # known only while the source is open
            completed=self._source.position,
        )

    def interrupted(self) -> None:
        """Show that an interrupted run is being written."""
        self._describe("interrupted, writing the partial map (interrupt again to quit)")

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Show that the report is being written."""
        del known
        if not outcome.partial:
            self._describe("writing the report")

    def show(self, what: str, share: float) -> None:
        """Show what is being written after the run, and the share that is done."""
        if self._display is not None:
            self._display.update(self._task, description=what, total=1.0, completed=share)

    def _describe(self, description: str) -> None:
        if self._display is not None:
            self._display.update(self._task, description=description)
