"""EKF SLAM on one page: predict, observe, associate, correct, extend (thesis Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from impslam.association.base import Association
from impslam.filters.base import Filter
from impslam.geometry.se2 import compose
from impslam.landmarks.base import LandmarkModel
from impslam.lifecycle.base import Lifecycle
from impslam.sensors.base import Reading
from impslam.types import Array, Increment, Landmark, StepResult

START_SIGMA = 1e-4
"""m and rad: the start is the map's origin by definition; this only keeps P positive definite."""


class Slam:
    """Estimates the robot's path and a map of landmarks, one reading at a time."""

    def __init__(
        self,
        belief: Filter,
        association: Association,
        lifecycle: Lifecycle,
        models: Mapping[str, LandmarkModel],
        start: Array | None = None,
    ) -> None:
        self.filter, self.association, self.lifecycle = belief, association, lifecycle
        self._odometry = np.zeros(3) if start is None else np.array(start, dtype=np.float64)
        self.filter.start(self._odometry, START_SIGMA**2 * np.eye(3), models)
        self.lifecycle.start(models, association, type(belief)())

    def step(self, increment: Increment, reading: Reading) -> StepResult:
        """Take in the motion since the last reading, and the reading itself."""
        observations, stamp = reading.observations, increment.stamp

        self.filter.predict(increment)
        self.lifecycle.move(increment)
        self._odometry = compose(self._odometry, increment.d_pose)

        choice = self.filter.associate(observations, self.association)

        self.filter.correct(observations, choice.matches)
        self.filter.note(observations, choice.matches, stamp)

        unmatched = [observations[i] for i in choice.new]
        lost = self.filter.state_size == len(self.filter.pose)
        new = self.filter.extend(self.lifecycle.promote(unmatched, stamp, lost), stamp)

        removed: list[int] = []
        if reading.scan is not None and observations:
            ids, outlines = self.filter.outlines()
            removed = self.lifecycle.review(
                reading.scan, self.filter.pose, ids, outlines, choice.matches
            )
            self.filter.remove(removed)

        return StepResult(
            stamp,
            self.filter.pose,
            self.filter.covariance,
            self._odometry.copy(),
            self.filter.pose,
            reading.scan,
            observations,
            choice.matches,
            new,
            tuple(removed),
        )

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the map in the form users read."""
        return self.filter.landmarks()
