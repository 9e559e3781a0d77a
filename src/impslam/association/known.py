"""Association by the labels that a sensor reads (barcodes, simulation): the bound for the others."""

from __future__ import annotations

from impslam.association.assignment import collect
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.component import register
from impslam.types import Mask, Observation


@register("known")
class Known(Association):
    """Each label is one landmark; observations without a label are matched to nothing."""

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Pair each labelled observation with the landmark whose label it bears."""
        del joint
        return collect(
            observations, ((group, *self._choose(observations, group)) for group in hypotheses)
        )

    @staticmethod
    def _choose(
        observations: tuple[Observation, ...], group: Hypotheses
    ) -> tuple[list[tuple[int, int]], Mask]:
        labels = [observations[i].label for i in group.observations]
        known = {int(label): k for k, label in enumerate(group.labels) if label >= 0}
        pairs = [
            (a, known[label])
            for a, label in enumerate(labels)
            if label is not None and label in known
        ]
        unlabelled = group.observations < 0
        for a, label in enumerate(labels):
            unlabelled[a] = label is None
        return pairs, unlabelled
