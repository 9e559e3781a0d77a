"""Association by the labels that a sensor reads (barcodes, simulation): the bound for the others.

Labels that are read off the world can be misread, and then the landmark that bears the label is
elsewhere. With a gate such an observation is refused: it neither corrects nor begins a landmark.
"""

from __future__ import annotations

import numpy as np

from impslam.association.assignment import collect
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantile
from impslam.types import Observation


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
    ) -> tuple[list[int], list[int]]:
        read = [observations[i].label for i in group.observations.tolist()]
        labels = np.array([-1 if label is None else label for label in read], np.int64)
        borne = (labels >= 0) & (labels == group.labels)
        newest = {
            int(group.observations[p]): int(group.landmarks[p]) for p in np.flatnonzero(borne)
        }
        best: dict[int, int] = {}  # a label that is read twice belongs to the nearer
        for p in np.flatnonzero(borne).tolist():
            k = int(group.landmarks[p])
            if newest[int(group.observations[p])] == k:  # of several that bear its label
                rival = best.get(k, p)
                best[k] = min(p, rival, key=lambda q: (group.distance2[q], q))
        limit = quantile(self.gate, group.innovation.shape[-1])
        near = np.flatnonzero(borne | (labels < 0)).tolist()
        return [p for p in best.values() if group.distance2[p] <= limit], near
