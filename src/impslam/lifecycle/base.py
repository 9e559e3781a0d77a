"""The interface of lifecycles, which decide when landmarks are added and removed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

from impslam.association.base import Association
from impslam.component import Component
from impslam.filters.base import Filter
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Increment, Ints, Match, Observation, Scan


class Lifecycle(Component):
    """Decides which observations become landmarks of the filter, and which landmarks are removed."""

    role: ClassVar[str] = "lifecycle"

    @abstractmethod
    def start(
        self, models: Mapping[str, LandmarkModel], association: Association, tracker: Filter
    ) -> None:
        """Begin with the run's models and association, and a filter for the lifecycle's own use."""

    @abstractmethod
    def move(self, increment: Increment) -> None:
        """Follow the robot's motion."""

    def recognise(
        self, observations: tuple[Observation, ...], motion: Increment
    ) -> tuple[Match, ...]:
        """Match unmatched observations with candidates that are not in the map yet, after a motion.

        The state does not change.
        """
        del observations, motion
        return ()

    @abstractmethod
    def promote(self, observations: Sequence[Observation], stamp: float, lost: bool) -> list[int]:
        """Return the unmatched observations (indices) that become landmarks now.

        `lost` is true while the map is empty: no landmark relates the robot to its start yet.
        """

    @abstractmethod
    def review(
        self, scan: Scan, pose: Array, ids: Ints, outlines: Array, matches: Sequence[Match]
    ) -> list[int]:
        """Return the ids of landmarks to remove: visible from the pose (3,), but not observed.

        `ids` (k,) are those of the map, `outlines` (k, 2, 2) their ends in map, m.
        """
