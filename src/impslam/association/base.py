"""The interface of associations, which select among the hypotheses that a filter has scored."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from impslam.component import Component
from impslam.errors import ConfigError
from impslam.types import Array, Ints, Mask, Match, Observation

Joint: TypeAlias = Callable[[Sequence[Observation], Sequence[Match]], tuple[Array, Array]]
"""Returns the joint innovation and covariance of pairs: `Filter.joint` of the calling filter."""


class Hypotheses(NamedTuple):
    """The p scored pairings of a observations with landmarks of one kind.

    They are in the order of the observations, then of the landmarks. Only pairings beyond the gate of
    the association are missing.

    Attributes
    ----------
    kind : of landmark
    observations : (p,) indices in the given list
    landmarks : (p,) ids
    labels : (p,) labels that sensors read on the landmarks, -1 for none
    innovation : (p, dim_z)
    S : (p, dim_z, dim_z), covariance of the innovation
    distance2 : (p,), squared Mahalanobis distance
    log_det : (p,), log determinant of S
    distances : returns `LandmarkModel.distance` of the pairings, in base_link if True, else in map
    possible : (p,), false where extents rule the pairing out
    unique : whether a landmark of the kind exists once, so that no other one can have been observed
    in_pieces : whether several observations of a scan can show one landmark, as pieces of a wall do
    """

    kind: str
    observations: Ints
    landmarks: Ints
    labels: Ints
    innovation: Array
    S: Array
    distance2: Array
    log_det: Array
    distances: Callable[[bool], tuple[Array, Array]]
    possible: Mask
    unique: bool = False
    in_pieces: bool = False

    def matches(self, pairs: Sequence[int]) -> list[Match]:
        """Return some of the p pairings."""
        innovation, S = self.innovation, self.S
        observations, landmarks = self.observations.tolist(), self.landmarks.tolist()
        distance2 = self.distance2.tolist()
        return [
            Match(observations[p], landmarks[p], innovation[p], S[p], distance2[p]) for p in pairs
        ]


class Rivals(NamedTuple):
    """Two landmarks (ids, the older first) that match one observation of a scan, or several (`as_two`)."""

    landmarks: tuple[int, int]
    as_two: bool


class Assignment(NamedTuple):
    """Matches, and observations (indices) that match no landmark and may become a new one.

    An observation in neither is too near a landmark to be new and too far to match it, or it is
    `ambiguous`: it passes the gate of a landmark, but not jointly with the other matches, or another
    choice is nearly as likely.
    """

    matches: tuple[Match, ...]
    new: tuple[int, ...]
    rivals: tuple[Rivals, ...] = ()
    ambiguous: tuple[int, ...] = ()


class Association(Component):
    """Selects among hypotheses."""

    role: ClassVar[str] = "association"
    is_joint: ClassVar[bool] = False
    """Whether a pairing depends on pairings of other observations and landmarks."""

    def max_distance2(self, dof: int) -> float:
        """Return the squared Mahalanobis distance beyond which pairings are ignored."""
        del dof
        return math.inf

    def is_same_landmark(self, innovation: Array, S: Array) -> bool:
        """Return whether two landmarks with an innovation (dim_z,) of covariance S are the same.

        The default is False, for associations without such a test.
        """
        del innovation, S
        return False

    def for_known_pose(self) -> Association:
        """Return an association for a known pose, given which pairings are independent."""
        return self

    @abstractmethod
    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Match observations with landmarks, each landmark at most once.

        `joint` is used by associations that test pairs jointly.
        """

    def choose(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Return what `assign` returns, checked, because it may be that of a plug-in.

        Raises
        ------
        ConfigError
            If these are no pairs of the hypotheses and indices of the observations.
        """
        choice = self.assign(observations, hypotheses, joint)
        if wrong := _defect(choice, len(observations), hypotheses):
            raise ConfigError(
                f"association {self.name!r} returned {wrong}; correct it, the contract is Association in "
                "impslam.association.base"
            )
        return choice


def _defect(choice: Any, count: int, hypotheses: list[Hypotheses]) -> str:
    """Return what is wrong with an assignment of `count` observations, or ""."""
    if not isinstance(choice, Assignment):
        return f"{type(choice).__name__} in place of an Assignment"
    pairs: set[tuple[int, int]] = set()
    for one in hypotheses:
        pairs.update(zip(one.observations.tolist(), one.landmarks.tolist(), strict=True))
    matches: tuple[Any, ...] = choice.matches
    for match in matches:
        if not isinstance(match, Match):
            return f"{type(match).__name__} in place of a Match"
        if (match.observation, match.landmark) not in pairs:
            return (
                f"a match of observation {match.observation} with landmark {match.landmark}, which is not "
                "among the hypotheses"
            )
    for i in (*choice.new, *choice.ambiguous):
        if not (isinstance(i, int | np.integer) and 0 <= i < count):
            return f"the index {i} of {count} observations"
    return ""


def log_normal(distance2: float, S: Array) -> float:
    """Return the log density of N(0, S) at a squared Mahalanobis distance."""
    log_det = float(np.linalg.slogdet(2.0 * math.pi * S)[1])
    return -0.5 * (distance2 + log_det)
