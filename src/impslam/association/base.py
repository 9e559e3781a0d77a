"""The role of association: score (a filter's hypotheses) and choose (an association) apart."""

from __future__ import annotations

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
    """Every pairing of a observations with k landmarks of one kind, scored.

    Attributes
    ----------
    kind : of landmark
    observations : (a,) indices into the list that was asked about
    landmarks : (k,) ids
    labels : (k,) labels that sensors read off the landmarks, -1 where there is none
    innovation : (a, k, dim_z)
    S : (a, k, dim_z, dim_z), covariance of the innovation
    distance2 : (a, k), squared Mahalanobis distance
    log_det : (a, k), log determinant of S
    apart : returns the thesis's distance (a, k) m and angle (a, k) rad in map, when asked
    possible : (a, k), false where extents rule the pairing out
    """

    kind: str
    observations: Ints
    landmarks: Ints
    labels: Ints
    innovation: Array
    S: Array
    distance2: Array
    log_det: Array
    apart: Callable[[], tuple[Array, Array]]
    possible: Mask

    def match(self, a: int, k: int) -> Match:
        """Return the pairing of the a-th observation and k-th landmark here."""
        return Match(
            int(self.observations[a]),
            int(self.landmarks[k]),
            self.innovation[a, k],
            self.S[a, k],
            float(self.distance2[a, k]),
        )


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

    @abstractmethod
    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Return which observation is which landmark; each landmark at most once.

        `joint` is for those that judge pairs together; the others do not call it.
        """
