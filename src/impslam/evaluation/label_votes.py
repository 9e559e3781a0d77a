"""Count wrong data associations in logs with labelled observations."""

from __future__ import annotations

from collections import Counter

from impslam.map import Keyframe, PathRows, Revision
from impslam.observers.base import Observer
from impslam.types import Landmark


class LabelVotes(Observer):
    """Counts the labels of the observations matched with each landmark.

    The label of a landmark is the most frequent one; matches with other labels are wrong.
    """

    def __init__(self) -> None:
        self._votes: dict[int, Counter[int]] = {}
        self.observations = 0

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Count the labels of a keyframe."""
        del path
        self.observations += len(keyframe.observations)
        for match in revision.matches:
            label = keyframe.observations[match.observation].label
            if label is not None:
                self._votes.setdefault(match.landmark, Counter())[label] += 1

    @property
    def matched(self) -> int:
        """Number of labelled observations that were matched with a landmark."""
        return sum(sum(votes.values()) for votes in self._votes.values())

    @property
    def wrong(self) -> int:
        """Number of observations that were matched with a landmark of another label."""
        return self.matched - sum(max(votes.values()) for votes in self._votes.values())

    def label(self, mark: Landmark) -> int | None:
        """Return the most frequent label of a landmark's observations; None if it has none."""
        votes = self._votes.get(mark.id)
        return None if votes is None else max(votes, key=lambda label: votes[label])
