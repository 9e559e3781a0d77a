"""The role of association: score (a filter's hypotheses) and choose (an association) apart."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from impslam.component import Component
from impslam.types import Array, Ints, Mask, Match, Observation

Joint: TypeAlias = Callable[[Sequence[Observation], Sequence[Match]], tuple[Array, Array]]
"""Gives the joint innovation and covariance of pairs: `Filter.joint` of whoever asks."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """The p pairings of a observations with landmarks of one kind that are worth judging, scored.

    They stand in the order of the observations, then of the landmarks. Left out are only pairings
    beyond the gate that the association asked for.

    Attributes
    ----------
    kind : of landmark
    asked : (a,) indices of all observations of the kind into the list that was asked about
    observations : (p,) such an index
    landmarks : (p,) ids
    labels : (p,) labels that sensors read off the landmarks, -1 where there is none
    innovation : (p, dim_z)
    S : (p, dim_z, dim_z), covariance of the innovation
    distance2 : (p,), squared Mahalanobis distance
    log_det : (p,), log determinant of S
    apart : returns `LandmarkModel.distance` of the pairings, in base_link if True, else in map
    possible : (p,), false where extents rule the pairing out
    unique : whether there is one landmark of the kind, so that nothing else can have been seen
    """

    kind: str
    asked: Ints
    observations: Ints
    landmarks: Ints
    labels: Ints
    innovation: Array
    S: Array
    distance2: Array
    log_det: Array
    apart: Callable[[bool], tuple[Array, Array]]
    possible: Mask
    unique: bool = False

    def matches(self, pairs: Sequence[int]) -> list[Match]:
        """Return some of the p pairings."""
        innovation, S = self.innovation, self.S
        asked, landmarks = self.observations.tolist(), self.landmarks.tolist()
        distance2 = self.distance2.tolist()
        return [Match(asked[p], landmarks[p], innovation[p], S[p], distance2[p]) for p in pairs]


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Matches, and observations (indices) that belong to no landmark and may begin one.

    An observation in neither is ambiguous: too near a landmark to be new, too far to be it.
    """

    matches: tuple[Match, ...]
    new: tuple[int, ...]


class Association(Component):
    """Chooses among hypotheses."""

    role: ClassVar[str] = "association"
    judges_jointly: ClassVar[bool] = False
    """Whether a pairing's fate depends on others than those of the same observation or landmark."""

    def reach(self, dof: int) -> float:
        """Return the squared Mahalanobis distance beyond which no pairing matters here."""
        del dof
        return math.inf

    @abstractmethod
    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Return which observation is which landmark; each landmark at most once.

        `joint` is for those that judge pairs together; the others do not call it.
        """
