"""Detect and fuse duplicate landmarks.

A known landmark is initialised again if the pose is too uncertain to match it. Later, after a loop closure,
both are at the same place. They are fused if no scan has shown both, several scans have shown one object
that could be either, and their difference is compatible with zero and much more likely so than for two
distinct landmarks of the kind. The correction with a difference of zero, without noise, makes the belief
that of a filter that has matched all observations with one landmark, up to linearisation.

Kinds that are seen in pieces, such as walls, are not fused: no scan can prove two of them distinct.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from impslam.association.base import Assignment, Association
from impslam.errors import NumericalError
from impslam.filters.base import Filter
from impslam.types import Match

MIN_SCANS = 4
"""Scans that show one object before two landmarks are fused: as many as initialise a landmark."""


@dataclass(slots=True, eq=False)
class Duplicates:
    """Evidence on pairs of landmarks at the same place, by ids: seen as one, or as two."""

    as_one: Counter[tuple[int, int]] = field(default_factory=Counter)
    two: set[tuple[int, int]] = field(default_factory=set)

    def fuse(self, choice: Assignment, filter_: Filter, association: Association) -> dict[int, int]:
        """Fuse duplicates; return the removed landmarks, each with the one that replaces it."""
        matched, fused = {match.landmark for match in choice.matches}, dict[int, int]()
        for pair, as_two in choice.rivals:
            if as_two or matched.issuperset(pair):
                self.two.add(pair)
            self.as_one[pair] += 1
            if (
                self.as_one[pair] < MIN_SCANS
                or pair in self.two
                or not fused.keys().isdisjoint(pair)
            ):
                continue
            if _fuse(pair, filter_, association):
                self._join(*pair)
                fused[pair[1]] = pair[0]
        return fused

    def _join(self, kept: int, gone: int) -> None:
        """Transfer the evidence that `gone` is distinct from others to `kept`."""
        for pair in [pair for pair in self.two if gone in pair]:
            other = pair[0] if pair[1] == gone else pair[1]
            self.two.add((min(kept, other), max(kept, other)))


def _fuse(pair: tuple[int, int], filter_: Filter, association: Association) -> bool:
    """Fuse two landmarks if they are one; return whether they were."""
    try:
        difference = filter_.difference(*pair)
        if difference is None or not association.is_same_landmark(*difference):
            return False
        filter_.fuse(*pair)
    except (NumericalError, np.linalg.LinAlgError):  # the difference is unknown: keep both
        return False
    return True


def with_kept_landmark(match: Match, fused: Mapping[int, int]) -> Match:
    """Return a match with its landmark replaced if that was fused."""
    return match._replace(landmark=fused.get(match.landmark, match.landmark))
