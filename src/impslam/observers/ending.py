"""The end of a run: its map, its outcome, and the last estimated and true poses."""

from __future__ import annotations

from impslam.map import Map
from impslam.observers.base import Outcome
from impslam.observers.recorder import TruthRecorder
from impslam.types import Array


class EndOfRun(TruthRecorder):
    """Keeps the map and outcome of a run; its poses are those of the last sweep located in the map."""

    known: Map | None = None
    outcome: Outcome | None = None

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Keep the map and the outcome."""
        self.known, self.outcome = known, outcome

    @property
    def pose(self) -> Array | None:
        """The last pose (3,); None before the end of the run."""
        return None if self.known is None else self.known.path()[-1, 1:]

    @property
    def odometry(self) -> Array | None:
        """The pose (3,) of the same sweep by dead reckoning."""
        return None if self.known is None else self.known.odometry()[-1, 1:]

    @property
    def true(self) -> Array | None:
        """The true pose (3,) at the same stamp, if the log contains it."""
        if self.known is None:
            return None
        rows = self.path[self.path[:, 0] == self.known.path()[-1, 0]]
        return rows[-1, 1:] if len(rows) else None
