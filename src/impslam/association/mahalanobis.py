"""Mahalanobis gate and optimal one-to-one assignment (Bar-Shalom & Fortmann 1988)."""

from __future__ import annotations

import math

import numpy as np

from impslam.association.assignment import collect, one_to_one
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantile
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask, Observation

_DOUBT = 2.0 * math.log(
    10.0
)  # between even odds and ten to one against, an observation stays unused


@kernel
def _judged(
    distance2: Array, log_det: Array, possible: Mask, gates: tuple[float, float], odds: float
) -> tuple[Ints, Array, Mask]:
    """Return the pairs (p,) to choose from, the costs (k,) of all, and which (k,) leave nothing new."""
    cost, near = distance2 + log_det + odds, np.zeros(len(possible), np.bool_)
    pairs, count = np.empty(len(cost), np.int64), 0
    for k in range(len(cost)):
        if possible[k]:
            near[k] = distance2[k] < gates[1] and cost[k] < _DOUBT
            if distance2[k] < gates[0] and cost[k] < 0.0:
                pairs[count] = k
                count += 1
    return pairs[:count], cost, near


@register("mahalanobis")
class Mahalanobis(Association):
    """Chi-square gate on the innovation, then the most likely one-to-one assignment.

    A gate alone takes the first wall it meets once the pose is uncertain by metres. So a pairing must
    also be likelier than that the observation shows something else of its kind: N(nu; 0, S) above the
    density of such things in measurement space (Bar-Shalom & Fortmann 1988, ch. 9; Reid 1979, Eq. 16).
    """

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
    density: float = parameter(
        0.3,
        "1/z",
        "other landmarks of the kind in a unit of measurement space: walls in 1 m and 1 rad (in maps of "
        "offices 0.25 to 0.5), points in 1 m^2 (there fewer; outdoors far fewer)",
        gt=0,
    )

    def reach(self, dof: int) -> float:
        """Return the wider gate; see `Association.reach`."""
        return quantile(max(self.gate, self.new_gate), dof)

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Minimise the sum of d^2 + log|S| over the pairs inside the gate."""
        del joint
        return collect(observations, ((group, *self._choose(group)) for group in hypotheses))

    def _choose(self, group: Hypotheses) -> tuple[list[int], Mask]:
        dim = group.innovation.shape[-1]
        # -2 log of the odds that this is the landmark, against that it is another like it.
        odds = dim * math.log(2.0 * math.pi) + 2.0 * math.log(self.density)
        gates = quantile(self.gate, dim), quantile(self.new_gate, dim)
        pairs, cost, near = _judged(group.distance2, group.log_det, group.possible, gates, odds)
        if group.unique:
            pairs = ((group.distance2 < gates[0]) & group.possible).nonzero()[0]
        best = one_to_one(group.observations[pairs], group.landmarks[pairs], cost[pairs])
        return pairs[best].tolist(), near
