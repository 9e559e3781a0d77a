"""The thesis's lifecycle: an unmatched observation becomes a landmark at once, and stays (2.1.3, 5.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from impslam.association.base import Association
from impslam.component import register
from impslam.filters.base import Filter
from impslam.landmarks.base import LandmarkModel
from impslam.lifecycle.base import Lifecycle
from impslam.types import Array, Increment, Ints, Match, Observation, Scan


@register("immediate")
class Immediate(Lifecycle):
    """Every unmatched observation becomes a landmark; none is ever removed."""

    def start(
        self, models: Mapping[str, LandmarkModel], association: Association, tracker: Filter
    ) -> None:
        """Do nothing; there is no state."""

    def move(self, increment: Increment) -> None:
        """Do nothing; there is no state."""

    def promote(self, observations: Sequence[Observation], stamp: float, lost: bool) -> list[int]:
        """Return all observations."""
        del stamp, lost
        return list(range(len(observations)))

    def review(
        self, scan: Scan, pose: Array, ids: Ints, outlines: Array, matches: Sequence[Match]
    ) -> list[int]:
        """Remove nothing."""
        del scan, pose, ids, outlines, matches
        return []
