"""Gates around the predicted observations of landmarks: for matches, and for new landmarks."""

from __future__ import annotations

import numpy as np

from impslam.association.base import Association, Hypotheses
from impslam.component import parameter
from impslam.geometry.chi_square import quantile
from impslam.types import Mask


class GatedAssociation(Association):
    """An association that matches within a gate, and starts landmarks outside a wider one."""

    gate: float = parameter(
        0.999, "1", "probability that a true pairing passes the chi-square gate", gt=0, lt=1
    )
    new_gate: float = parameter(
        0.999999,
        "1",
        "an unmatched observation within this gate of a landmark does not become a new landmark",
        gt=0,
        lt=1,
    )

    def max_distance2(self, dof: int) -> float:
        """Return the wider gate; see `Association.max_distance2`."""
        return quantile(max(self.gate, self.new_gate), dof)

    def _inside(self, group: Hypotheses) -> Mask:
        """Return which pairs pass the gate by themselves."""
        return _within(group, self.gate)

    def _near(self, group: Hypotheses) -> Mask:
        """Return which pairs are too near for a new landmark."""
        return _within(group, self.new_gate)


def _within(group: Hypotheses, probability: float) -> Mask:
    limit = quantile(probability, group.innovation.shape[-1])
    return np.asarray((group.distance2 < limit) & group.possible)
