"""The role of a filter: the joint belief over robot and landmarks."""

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
from impslam.types import (
    NO_COVARIANCE,
    Array,
    ErrorEstimate,
    Increment,
    Innovation,
    Ints,
    Landmark,
    Match,
    Observation,
)

Reach: TypeAlias = Callable[[int], float]


def everything(dof: int) -> float:
    """Return infinity: a `Reach` that excludes no pairing."""
    del dof
    return math.inf


class Filter(Component):
    """The joint estimate of robot and landmarks.

    Association is called through the filter, so that a filter may have several hypotheses.
    """

    role: ClassVar[str] = "filter"
    follows: ClassVar[bool] = False
    """Whether its mean can be set to that of another estimate; see `follow`."""
    considers_shared_errors: ClassVar[bool] = False
    """Whether `Observation.shared` is one constant error of its sensor, or independent each time.

    The same for `Increment.systematic`, which is replaced by random errors otherwise.
    """

    def fresh(self) -> Self:
        """Return a new filter with these parameters, not started."""
        return type(self)(**dict(self))

    def copied(self) -> Self:
        """Return an independent copy; landmark models are shared."""
        return copy.deepcopy(self)

    def resembles(self, other: Filter, share: float) -> bool:
        """Return whether another belief has the same landmarks and differs by at most `share` sigma.

        Returns False from a filter that cannot compare.
        """
        del other, share
        return False

    def log_densities(
        self, observations: Sequence[Observation], matches: Sequence[Match], *, alone: bool = False
    ) -> Array:
        """Return the log density (matches,) of each match's innovation, with the noise of `correct`.

        With `alone` the noise is that of a single observation, even if corrections inflate it because
        errors repeat.
        """
        del observations, alone
        return np.array([log_normal(match.distance2, match.S) for match in matches])

    def noise_factors(self, matches: Sequence[Match]) -> Array | None:
        """Return the factors (matches,) by which `correct` multiplies R; None: all 1."""
        del matches
        return None

    def follow(self, pose: Array, landmarks: Mapping[int, Array]) -> None:
        """Set the mean to a pose (3,) and the states (dim,) of landmarks by id.

        The covariance does not change.
        """
        raise NotImplementedError(f"the filter {self.name!r} cannot follow another estimate")

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

        `reach` maps degrees of freedom to a squared Mahalanobis distance; pairings beyond may be left out.
        """

    @abstractmethod
    def joint(
        self, observations: Sequence[Observation], pairs: Sequence[Match]
    ) -> tuple[Array, Array]:
        """Return the stacked innovation (rows,) of some pairs and its joint covariance (rows, rows).

        Rows are in the order of the pairs. An observation or landmark may be in several pairs; the block
        between two pairs of one observation is meaningless, because they exclude each other.
        """

    def associate(
        self, observations: tuple[Observation, ...], association: Association
    ) -> Assignment:
        """Match observations with landmarks; a filter with several hypotheses does so for each."""
        hypotheses = self.hypothesise(observations, association.max_distance2)
        return association.choose(observations, hypotheses, self.joint)

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

    def difference(self, one: int, other: int) -> tuple[Array, Array] | None:
        """Return the difference (dim_z,) of two landmarks of a kind as observed, and its covariance.

        None from a filter that cannot compute it.
        """
        del one, other
        return None

    def fuse(self, kept: int, gone: int) -> None:
        """Fuse two landmarks by a noise-free correction with a `difference` of zero.

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

    @property
    def systematic_errors(self) -> ErrorEstimate | None:
        """What is known of the systematic errors of odometry; None if they are not in the state."""
        return None

    @abstractmethod
    def outlines(self) -> tuple[Ints, Array]:
        """Return the ids (k,) of visible landmarks and their ends (k, 2, 2) in map.

        These are all landmarks, or at least all that may be in view. Unique landmarks, such as a GPS frame,
        are not visible and not included.
        """

    @abstractmethod
    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`."""

    def landmark_covariance(self) -> Array:
        """Return the joint covariance (2 k, 2 k) of the k `landmarks`, in their order.

        Empty, (0, 0), from a filter that has none.
        """
        return NO_COVARIANCE

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of scalars in the state."""
