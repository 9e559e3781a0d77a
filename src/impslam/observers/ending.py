"""The end of a run: its map, its outcome, and the true pose where the path ends."""

from __future__ import annotations

from impslam.map import Map
from impslam.observers.base import Outcome
from impslam.observers.recorder import Truth
from impslam.types import Array


class EndOfRun(Truth):
    """Keeps the map, and tells the last pose and the true one at its stamp."""

    known: Map | None = None
    outcome: Outcome | None = None

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Keep the map."""
        self.known, self.outcome = known, outcome

    @property
    def pose(self) -> Array | None:
        """The last pose (3,), None before the end of the run."""
        return None if self.known is None else self.known.path()[-1, 1:]

    @property
    def odometry(self) -> Array | None:
        """The last pose (3,) by dead reckoning."""
        return None if self.known is None else self.known.odometry_poses[-1]

    @property
    def true(self) -> Array | None:
        """The true pose (3,) at the last scan's stamp, if the log tells it."""
        if self.known is None:
            return None
        at = self.path[self.path[:, 0] == self.known.stamps[-1]]
        return at[-1, 1:] if len(at) else None
