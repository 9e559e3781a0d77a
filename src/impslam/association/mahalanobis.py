"""Mahalanobis gate and optimal one-to-one assignment (Bar-Shalom & Fortmann 1988)."""

from __future__ import annotations

import math

import numpy as np

from impslam.association.assignment import (
    DENSITY,
    MIN_ODDS,
    ambiguous,
    cost_of_new,
    make_assignment,
    odds_cost,
    rivals,
    unambiguous_pairs,
    unclaimed_pairs,
)
from impslam.association.base import Assignment, Hypotheses, Joint, log_normal
from impslam.association.gates import GatedAssociation
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantile
from impslam.types import Array, Mask, Observation

_UNIQUE_BONUS = 1e6  # a unique landmark always beats a new one


@register("mahalanobis")
class Mahalanobis(GatedAssociation):
    """Chi-square gate on the innovation, then the most likely one-to-one assignment.

    Once the pose is uncertain by metres, a gate alone accepts any wall. So a pairing must also be likelier
    than an observation of another object of the kind: N(nu; 0, S) above the
    density of such objects in measurement space (Bar-Shalom & Fortmann 1988, ch. 9; Reid 1979, Eq. 16).

    Most of them are in the map: a tenth of the density accounts for those that are not. An assignment must
    be `odds` times as likely as the likeliest one without the pairing: with another landmark, or with
    a new one. If the odds are nearer to even, the observation is not used (Chow 1970),
    unless it is a piece of a wall: of two walls the likelier one is chosen.
    """

    density: float = parameter(
        DENSITY,
        "1/z",
        "density of other landmarks of the kind in measurement space: walls per m and rad (0.25 to 0.5 in "
        "maps of offices), points per m^2 (fewer; outdoors far fewer)",
        gt=0,
    )
    odds: float = parameter(
        MIN_ODDS,
        "1",
        "a match must be this many times as likely as the best assignment without it: a wrong match "
        "costs as much as this many unused observations",
        ge=1,
    )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Minimise the sum of d^2 + log|S| over the pairs inside the gate; keep unambiguous ones."""
        del joint
        inside = [self._inside(group) for group in hypotheses]
        chosen = [(g, *self._choose(g, here)) for g, here in zip(hypotheses, inside, strict=True)]
        assignment = make_assignment(observations, chosen)
        if len(assignment.matches) == sum(map(np.count_nonzero, inside)):
            return assignment  # each pair inside is a match
        ambiguous_pairs = [
            r for g, here in zip(hypotheses, inside, strict=True) for r in rivals(g, here)
        ]
        unmatched = ambiguous(assignment.matches, hypotheses, inside)
        return assignment._replace(rivals=tuple(ambiguous_pairs), ambiguous=unmatched)

    def _choose(self, group: Hypotheses, inside: Mask) -> tuple[list[int], list[int]]:
        """Return the matching pairs, and the pairs that keep their observation from being new."""
        cost = group.distance2 + group.log_det
        cost += cost_of_new(self.density, group.innovation.shape[1])
        if group.unique:
            cost = group.distance2 - _UNIQUE_BONUS
        likely = group.possible & (cost < 0.0)
        pairs = (inside & likely).nonzero()[0]
        arguments = group.observations[pairs], group.landmarks[pairs], cost[pairs]
        taken = unambiguous_pairs(*arguments, odds_cost(self.odds), group.in_pieces)
        pair_list = pairs.tolist()
        chosen = [pair_list[p] for p in taken]
        return chosen, unclaimed_pairs(group, likely & self._near(group), chosen)

    def is_same_landmark(self, innovation: Array, S: Array) -> bool:
        """Return whether a difference in the gate is `odds` times as likely as two separate landmarks.

        `innovation` (d,) is the difference, S (d, d) its covariance.
        """
        distance2 = float(innovation @ np.linalg.solve(S, innovation))
        if distance2 > quantile(self.gate, len(innovation)):
            return False
        return log_normal(distance2, S) > math.log(self.odds * self.density)
