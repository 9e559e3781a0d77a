"""The role of a filter: it holds the joint belief over robot and landmarks."""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Self, TypeAlias

import numpy as np

from impslam.association.base import Assignment, Association, Hypotheses, log_normal
from impslam.component import Component
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Increment, Innovation, Ints, Landmark, Match, Observation

Reach: TypeAlias = Callable[[int], float]


def everything(dof: int) -> float:
    """Return no bound: the `Reach` that excludes no pairing."""
    del dof
    return math.inf


class Filter(Component):
    """The joint estimate of robot and landmarks.

    Association is called through the filter, so that a filter may hold several hypotheses.
    """

    role: ClassVar[str] = "filter"
    follows: ClassVar[bool] = False
    """Whether its mean can be put where another estimate has it; see `follow`."""
    considers_shared_errors: ClassVar[bool] = False
    """Whether `Observation.shared` is one error of its sensor; else it is taken for new each time."""

    def fresh(self) -> Self:
        """Return a new filter with these parameters, not started."""
        return type(self)(**dict(self))

    def copied(self) -> Self:
        """Return a filter of the same belief that goes on by itself; landmark models are shared."""
        return copy.deepcopy(self)

    def resembles(self, other: Filter, share: float) -> bool:
        """Tell whether another belief is of the same landmarks and differs by a share of sigma at most.

        A filter that cannot tell says no.
        """
        del other, share
        return False

    def log_densities(
        self, observations: Sequence[Observation], matches: Sequence[Match], *, alone: bool = False
    ) -> Array:
        """Return the log density (matches,) of each match's innovation, with the noise of `correct`.

        With `alone` the noise is that of one observation, even if a correction takes it larger because
        errors repeat.
        """
        del observations, alone
        return np.array([log_normal(match.distance2, match.S) for match in matches])

    def doubt(self, matches: Sequence[Match]) -> Array | None:
        """Return how many times R counts (matches,) in `correct`; None: once."""
        del matches
        return None

    def follow(self, pose: Array, landmarks: Mapping[int, Array]) -> None:
        """Take a pose (3,), and the states (dim,) of landmarks by id, for its mean.

        What it knows of their errors stays.
        """
        raise NotImplementedError(f"the filter {self.name!r} follows no other estimate")

    @abstractmethod
    def start(self, pose: Array, covariance: Array, models: Mapping[str, LandmarkModel]) -> None:
        """Begin with a pose (3,), its covariance (3, 3), and the models by kind; discard other state."""

    @abstractmethod
    def predict(self, increment: Increment) -> None:
        """Move the robot (thesis Eq. 2.23-2.26)."""

    @abstractmethod
    def undo_predict(self) -> None:
        """Undo the last `predict` exactly; nothing else may have changed the state since."""

    @abstractmethod
    def hypothesise(
        self, observations: Sequence[Observation], reach: Reach = everything
    ) -> list[Hypotheses]:
        """Score the pairings of observations with landmarks of their kind.

        `reach` gives for degrees of freedom a squared Mahalanobis distance; what is beyond may be left out.
        """

    @abstractmethod
    def joint(
        self, observations: Sequence[Observation], pairs: Sequence[Match]
    ) -> tuple[Array, Array]:
        """Return the stacked innovation (rows,) of some pairs and its joint covariance (rows, rows).

        Rows stand in the order of the pairs. An observation or landmark may be in several pairs: the
        block between two pairs of one observation is meaningless, because they exclude each other.
        """

    def associate(
        self, observations: tuple[Observation, ...], association: Association
    ) -> Assignment:
        """Match observations with landmarks; a filter with several hypotheses does so for each."""
        hypotheses = self.hypothesise(observations, association.reach)
        return association.assign(observations, hypotheses, self.joint)

    @abstractmethod
    def correct(
        self, observations: Sequence[Observation], matches: Sequence[Match]
    ) -> Innovation | None:
        """Correct the state by all matches of a scan in one batch (thesis Eq. 2.27-2.29).

        Return the joint innovation, or None if the filter does not compute it.

        Raises
        ------
        NumericalError
            If the covariance of the innovations is not positive definite; the state is not changed.
        """

    @abstractmethod
    def extend(self, observations: Sequence[Observation], stamp: float) -> tuple[int, ...]:
        """Add a landmark for each observation, with its full cross-covariance; return the ids."""

    @abstractmethod
    def remove(self, ids: Sequence[int]) -> None:
        """Remove landmarks from the state."""

    def apart(self, one: int, other: int) -> tuple[Array, Array] | None:
        """Return how far apart two landmarks of a kind are as seen, (dim_z,), and its covariance.

        None from a filter that cannot tell.
        """
        del one, other
        return None

    def fuse(self, kept: int, gone: int) -> None:
        """Make two landmarks one that `apart` tells about: their difference is zero, exactly.

        Raises
        ------
        NumericalError
            If the covariance of the difference is not positive definite; the state is not changed.
        """
        raise NotImplementedError(f"filter {self.name!r} cannot fuse landmarks")

    @abstractmethod
    def note(
        self, observations: Sequence[Observation], matches: Sequence[Match], stamp: float
    ) -> None:
        """Update extents, counts and stamps of the matched landmarks."""

    @property
    @abstractmethod
    def pose(self) -> Array:
        """`T_map_base` (3,)."""

    @property
    @abstractmethod
    def covariance(self) -> Array:
        """(3, 3) of the pose."""

    @abstractmethod
    def outlines(self) -> tuple[Ints, Array]:
        """Return the ids (k,) of landmarks and their visible ends (k, 2, 2) in map.

        Of all, or at least of those that may be in view.
        """

    @abstractmethod
    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the map in the form users read."""

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of scalars in the state."""
