"""What the demo needs to know of the truth: the end of the path, and the corners of the walls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from impslam.observers.base import Observer
from impslam.types import Array, StepResult, TrueLandmark, TruePose


def corners(truth: Sequence[TrueLandmark]) -> list[TrueLandmark]:
    """Return where two true walls meet, as landmarks of the kind corner."""
    walls = [wall for wall in truth if wall.end_points is not None]
    found = []
    for one, other in combinations(walls, 2):
        assert one.end_points is not None
        assert other.end_points is not None
        for place in one.end_points:
            if any(np.allclose(place, end, atol=1e-6) for end in other.end_points):
                name = f"corner of {one.name} and {other.name}"
                values = {"x": float(place[0]), "y": float(place[1])}
                found.append(TrueLandmark(name, "corner", place, values))
    return found


class EndOfRun(Observer):
    """Keeps the last pose, and the true pose at its stamp."""

    def __init__(self) -> None:
        self.pose: Array | None = None
        self.odometry: Array | None = None
        self._stamp = math.nan
        self._truth: dict[float, Array] = {}

    def truth(self, pose: TruePose) -> None:
        """Keep the true poses since the last scan."""
        self._truth[pose.stamp] = pose.pose

    def step(self, result: StepResult) -> None:
        """Move on."""
        self.pose, self.odometry, self._stamp = result.pose, result.odometry, result.stamp
        self._truth = {t: pose for t, pose in self._truth.items() if t >= result.stamp}

    @property
    def true(self) -> Array | None:
        """The true pose (3,) at the last scan's stamp, if the log tells it."""
        return self._truth.get(self._stamp)
