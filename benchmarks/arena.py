"""The arena of the thesis within limits: what the tests and the figures in the README ask of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from impslam.evaluation.landmarks import LandmarkScore
from impslam.studies.arena_runs import Way, drive_and_map
from impslam.studies.arena_scores import NAMED

CYLINDER, END, WALL = 0.03, 0.03, 0.02  # m, what the default preset is to keep


@dataclass(frozen=True)
class ArenaScore:
    """Errors of one run, m; a wall's is across it, at its middle."""

    seed: int
    landmarks: LandmarkScore
    end: float
    wheels: float

    def worst(self, kind: str) -> float:
        """Return the largest error of walls or cylinders; infinite if one of either is missing."""
        if set(self.landmarks.missing) & set(NAMED):
            return math.inf
        return max(e.distance for e in self.landmarks.found if e.kind == kind)

    @property
    def kept(self) -> bool:
        """Tell whether every limit is kept and nothing false is in the map, corners included."""
        return (
            self.worst("cylinder") <= CYLINDER
            and self.worst("wall") <= WALL
            and self.end <= END
            and not self.landmarks.false
        )


def arena(seed: int, preset: str = "imp", settings: Sequence[str] = ()) -> ArenaScore:
    """Simulate and map the arena."""
    (run,) = drive_and_map((seed, (Way(preset, tuple(settings)),)))
    return ArenaScore(seed, run.score(), run.end, run.wheels)
