"""What the demo needs to know of the truth: where the path ends."""

from __future__ import annotations

import math

from impslam.observers.base import Observer
from impslam.types import Array, StepResult, TruePose


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
