"""Association by the labels that a sensor reads (barcodes, simulation): an upper bound for the others.

Labels can be misread; the landmark with that label is then elsewhere. With a gate such an observation is
rejected: it neither corrects nor creates a landmark.
"""

from __future__ import annotations

import numpy as np

from impslam.association.assignment import make_assignment
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantile
from impslam.types import Array, Observation


@register("known")
class Known(Association):
    """Each label is one landmark; observations without a label are matched to nothing.

    They become landmarks only while the map has none of their kind.
    """

    gate: float = parameter(
        1.0,
        "1",
        "probability that a true pairing passes the chi-square gate; 1: all labels are trusted",
        gt=0,
        le=1,
    )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Match each labelled observation with the landmark of the same label."""
        del joint
        return make_assignment(
            observations, ((group, *self._choose(observations, group)) for group in hypotheses)
        )

    def _choose(
        self, observations: tuple[Observation, ...], group: Hypotheses
    ) -> tuple[list[int], list[int]]:
        labels_read = [observations[i].label for i in group.observations.tolist()]
        labels = np.array([-1 if label is None else label for label in labels_read], np.int64)
        labelled = (labels >= 0) & (labels == group.labels)
        nearest: dict[int, int] = {}  # a new label that was read twice has two landmarks
        for p in np.flatnonzero(labelled).tolist():
            _keep_nearer(nearest, int(group.observations[p]), p, group.distance2)
        best: dict[int, int] = {}  # a label read twice belongs to the nearer observation
        for p in nearest.values():
            _keep_nearer(best, int(group.landmarks[p]), p, group.distance2)
        limit = quantile(self.gate, group.innovation.shape[-1])
        near = np.flatnonzero(labelled | (labels < 0)).tolist()
        return [p for p in best.values() if group.distance2[p] <= limit], near


def _keep_nearer(pairs: dict[int, int], key: int, p: int, distance2: Array) -> None:
    """Enter pair p under a key, unless another pair there is at least as near."""
    pairs[key] = min(pairs.get(key, p), p, key=lambda q: (distance2[q], q))
