"""Association by the labels that a sensor reads (barcodes, simulation): the bound for the others.

Labels that are read off the world can be misread, and then the landmark that bears the label is
elsewhere. With a gate such an observation is refused: it neither corrects nor begins a landmark.
"""

from __future__ import annotations

import numpy as np

from impslam.association.assignment import collect
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.association.gates import quantile
from impslam.component import parameter, register
from impslam.types import Mask, Observation


@register("known")
class Known(Association):
    """Each label is one landmark; observations without a label are matched to nothing."""

    gate: float = parameter(
        1.0,
        "1",
        "probability that a true pairing passes the chi-square gate; 1: no label is doubted",
        gt=0,
        le=1,
    )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Pair each labelled observation with the landmark whose label it bears."""
        del joint
        return collect(
            observations, ((group, *self._choose(observations, group)) for group in hypotheses)
        )

    def _choose(
        self, observations: tuple[Observation, ...], group: Hypotheses
    ) -> tuple[list[tuple[int, int]], Mask]:
        known = {int(label): k for k, label in enumerate(group.labels) if label >= 0}
        best: dict[int, int] = {}  # a label that is read twice belongs to the nearer
        taken = np.zeros(len(group.observations), np.bool_)
        for a, i in enumerate(group.observations):
            label = observations[i].label
            k = None if label is None else known.get(label)
            taken[a] = label is None or k is not None
            if k is not None:
                rival = best.get(k, a)
                best[k] = min(a, rival, key=lambda b: (group.distance2[b, k], b))
        limit = quantile(self.gate, group.innovation.shape[-1])
        return [(a, k) for k, a in best.items() if group.distance2[a, k] <= limit], taken
