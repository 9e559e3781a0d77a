"""The role of an estimator: keyframes in, revisions of the map out."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

from impslam.component import Component
from impslam.map import Keyframe, Revision
from impslam.types import Array, Landmark


class Estimator(Component):
    """Estimates the poses of keyframes and a map of landmarks, one keyframe at a time."""

    role: ClassVar[str] = "estimator"
    parts: ClassVar[tuple[str, ...]] = ()
    """Roles of the components that it is made of; `start` is given one of each."""

    @abstractmethod
    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map.

        `parts` are the components named in the class's `parts`, by role, and `models`, the landmark
        models by kind.
        """

    @abstractmethod
    def add(self, keyframe: Keyframe) -> Revision:
        """Take in a keyframe: its motion since the one before, and what is seen in it.

        A keyframe that cannot be used is told in the revision, which then holds the pose by its
        motion alone; it never leaves the estimator half changed.
        """

    @abstractmethod
    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks in the form users read."""

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of scalars that are estimated."""
