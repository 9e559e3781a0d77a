"""Landmarks that were begun twice: found by what scans show of them, and made one.

A landmark is begun anew where the pose was too uncertain to tell that it is known. Later, when a loop has
closed, both lie in one place. They are one if no scan has shown them as two, several scans have shown one
thing that could be either, and their difference is compatible with zero and far likelier by that than for
two of its kind. A correction with a difference of zero, without noise, then makes the belief that of a
filter which has matched all observations with one landmark, up to linearisation.

Kinds that are seen in pieces, such as walls, are not fused: no scan can show that two of them are not one.
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

SCANS = 4
"""That must show one thing before two landmarks are one: as many as begin a landmark."""


@dataclass(slots=True, eq=False)
class Duplicates:
    """What scans have shown of pairs of landmarks that lie in one place, by their ids."""

    as_one: Counter[tuple[int, int]] = field(default_factory=Counter)
    two: set[tuple[int, int]] = field(default_factory=set)

    def fuse(self, choice: Assignment, tracker: Filter, association: Association) -> dict[int, int]:
        """Make duplicates one; return which landmarks go, and which ones they have become."""
        matched, fused = {match.landmark for match in choice.matches}, dict[int, int]()
        for pair, as_two in choice.rivals:
            if as_two or matched.issuperset(pair):
                self.two.add(pair)
            self.as_one[pair] += 1
            few = self.as_one[pair] < SCANS
            if few or pair in self.two or not fused.keys().isdisjoint(pair):
                continue
            if _fuse(pair, tracker, association):
                self._join(*pair)
                fused[pair[1]] = pair[0]
        return fused

    def _join(self, kept: int, gone: int) -> None:
        """Let the one that stays be two with whatever the one that goes is two with."""
        for pair in [pair for pair in self.two if gone in pair]:
            other = pair[0] if pair[1] == gone else pair[1]
            self.two.add((min(kept, other), max(kept, other)))


def _fuse(pair: tuple[int, int], tracker: Filter, association: Association) -> bool:
    """Make landmarks one if they are; tell whether they were."""
    try:
        apart = tracker.apart(*pair)
        if apart is None or not association.is_same_landmark(*apart):
            return False
        tracker.fuse(*pair)
    except (
        NumericalError,
        np.linalg.LinAlgError,
    ):  # nothing is known of the difference: leave both
        return False
    return True


def of_kept(match: Match, fused: Mapping[int, int]) -> Match:
    """Return a match with the landmark that its own one has become."""
    return match._replace(landmark=fused.get(match.landmark, match.landmark))
