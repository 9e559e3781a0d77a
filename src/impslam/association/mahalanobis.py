"""Mahalanobis gate and optimal one-to-one assignment (Bar-Shalom & Fortmann 1988)."""

from __future__ import annotations

import numpy as np

from impslam.association.assignment import collect, one_to_one
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.association.gates import quantile
from impslam.component import parameter, register
from impslam.types import Mask, Observation


@register("mahalanobis")
class Mahalanobis(Association):
    """Chi-square gate on the innovation, then the most likely one-to-one assignment."""

    gate: float = parameter(
        0.999, "1", "probability that a true pairing passes the chi-square gate", gt=0, lt=1
    )
    new_gate: float = parameter(
        0.999999,
        "1",
        "an observation within this gate of a landmark, yet not matched, is too near to be new",
        gt=0,
        lt=1,
    )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Minimise the sum of d^2 + log|S| over the pairs inside the gate."""
        del joint
        return collect(observations, ((group, *self._choose(group)) for group in hypotheses))

    def _choose(self, group: Hypotheses) -> tuple[list[tuple[int, int]], Mask]:
        dim = group.innovation.shape[-1]
        allowed = (group.distance2 < quantile(self.gate, dim)) & group.possible
        near = (group.distance2 < quantile(self.new_gate, dim)) & group.possible
        # log|S| favours the pairing that was predicted best; shifted so that no pair costs less
        # than leaving both apart, hence as many pairs as the gate allows.
        return one_to_one(group.distance2 + group.log_det, allowed), np.asarray(near.any(axis=1))
