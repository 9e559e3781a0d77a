"""EKF SLAM on one page: predict, observe, associate, correct, extend (thesis Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from impslam.association.base import Association
from impslam.errors import NumericalError
from impslam.filters.base import Filter
from impslam.geometry.se2 import compose
from impslam.landmarks.base import LandmarkModel
from impslam.lifecycle.base import Lifecycle
from impslam.sensors.base import Reading
from impslam.types import Array, Increment, Landmark, Observation, StepResult

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
        self._models = models
        self._odometry = np.zeros(3) if start is None else np.array(start, dtype=np.float64)
        self.filter.start(self._odometry, START_SIGMA**2 * np.eye(3), models)
        self.lifecycle.start(models, association, belief.fresh())

    def step(
        self, increment: Increment, reading: Reading, felt: Increment | None = None
    ) -> StepResult:
        """Take in the motion since the last reading, and the reading itself.

        `felt` is the motion by odometry alone, where the increment was refined by more than that.

        Raises
        ------
        NumericalError
            If the reading cannot be taken in; nothing has changed then, and the motion is still owed.
        """
        _check_finite(reading.observations)
        observations, stamp = self._blur(reading.observations, increment), increment.stamp

        self.filter.predict(increment)
        try:
            choice = self.filter.associate(observations, self.association)
            self.filter.correct(observations, choice.matches)
        except NumericalError:
            self.filter.take_back()
            raise
        self.lifecycle.move(increment)
        self._odometry = compose(self._odometry, (felt or increment).d_pose)
        self.filter.note(observations, choice.matches, stamp)

        unmatched = [observations[i] for i in choice.new]
        lost = self.filter.state_size == len(self.filter.pose)
        born = tuple(choice.new[i] for i in self.lifecycle.promote(unmatched, stamp, lost))
        new = self.filter.extend([observations[i] for i in born], stamp)

        removed: list[int] = []
        ids, outlines = self.filter.outlines()
        if reading.scan is not None and reading.searched and len(ids):
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
            born,
        )

    def _blur(
        self, observations: tuple[Observation, ...], increment: Increment
    ) -> tuple[Observation, ...]:
        """Add to R what the motion between a reading's moment and an observation's is unsure by."""
        if increment.duration == 0.0:
            return observations
        rate = increment.covariance / increment.duration
        blurred = []
        for o in observations:
            J = self._models[o.kind].z_D_motion(o.z[None])[0]
            blurred.append(replace(o, R=o.R + abs(o.delay) * J @ rate @ J.T) if o.delay else o)
        return tuple(blurred)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the map in the form users read."""
        return self.filter.landmarks()


def _check_finite(observations: tuple[Observation, ...]) -> None:
    numbers = [part.ravel() for o in observations for part in (o.z, o.R)]
    if numbers and not np.isfinite(np.concatenate(numbers)).all():
        raise NumericalError("an extractor's observation is not finite")
