"""Mahalanobis gate and optimal one-to-one assignment (Bar-Shalom & Fortmann 1988)."""

from __future__ import annotations

import math

import numpy as np

from impslam.association.assignment import (
    ODDS,
    ambiguous,
    collect,
    decided,
    log_odds,
    rivals,
    unseen,
)
from impslam.association.base import Assignment, Association, Hypotheses, Joint, log_normal
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantile
from impslam.types import Array, Mask, Observation

_ALONE = 1e6  # what exists once has no rival but itself
_UNMAPPED = 0.1  # share of what is seen that is not in the map yet: most has been seen before


@register("mahalanobis")
class Mahalanobis(Association):
    """Chi-square gate on the innovation, then the most likely one-to-one assignment.

    A gate alone takes the first wall it meets once the pose is uncertain by metres. So a pairing must
    also be likelier than that the observation shows something else of its kind: N(nu; 0, S) above the
    density of such things in measurement space (Bar-Shalom & Fortmann 1988, ch. 9; Reid 1979, Eq. 16).

    Most of them are in the map: a tenth of the density stands for those that are not. An assignment must
    be `odds` times as likely as the likeliest one without the pairing: with another landmark, or with
    something new. Where the odds are nearer to even, the observation is not used (Chow 1970),
    unless it is a piece of a wall: of two walls the likelier one is taken.
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
    odds: float = parameter(
        ODDS,
        "1",
        "a match must be so many times as likely as the likeliest choice without it: so many unused "
        "observations are worth a wrong match",
        ge=1,
    )

    def reach(self, dof: int) -> float:
        """Return the wider gate; see `Association.reach`."""
        return quantile(max(self.gate, self.new_gate), dof)

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Minimise the sum of d^2 + log|S| over the pairs inside the gate; take those beyond doubt."""
        del joint
        inside = [self._inside(group) for group in hypotheses]
        chosen = [(g, *self._choose(g, here)) for g, here in zip(hypotheses, inside, strict=True)]
        made = collect(observations, chosen)
        if len(made.matches) == sum(map(np.count_nonzero, inside)):
            return made  # each pair inside is a match: nothing is open
        same = [r for g, here in zip(hypotheses, inside, strict=True) for r in rivals(g, here)]
        open_ = ambiguous(made.matches, hypotheses, inside)
        return made._replace(rivals=tuple(same), ambiguous=open_)

    def _inside(self, group: Hypotheses) -> Mask:
        """Tell which pairs pass the gate."""
        return group.possible & (group.distance2 < quantile(self.gate, group.innovation.shape[1]))

    def _choose(self, group: Hypotheses, inside: Mask) -> tuple[list[int], list[int]]:
        """Return the pairs that are matches, and those that may be what is seen all the same."""
        dim = group.innovation.shape[1]
        # -2 log of the odds that this is the landmark, against one like it that is not in the map.
        new = dim * math.log(2.0 * math.pi) + 2.0 * math.log(_UNMAPPED * self.density)
        distance2, cost = group.distance2, group.distance2 + group.log_det + new
        if group.unique:
            cost = distance2 - _ALONE
        likely = group.possible & (cost < 0.0)
        pairs = (inside & likely).nonzero()[0]
        seen = group.observations[pairs], group.landmarks[pairs], cost[pairs]
        taken, of = decided(*seen, log_odds(self.odds), group.in_pieces), pairs.tolist()
        chosen = [of[p] for p in taken]
        return chosen, unseen(group, likely & (distance2 < quantile(self.new_gate, dim)), chosen)

    def are_one(self, innovation: Array, S: Array) -> bool:
        """Tell whether a difference within the gate is `odds` times as likely as two of the density."""
        distance2 = float(innovation @ np.linalg.solve(S, innovation))
        if distance2 > quantile(self.gate, len(innovation)):
            return False
        return log_normal(distance2, S) > math.log(self.odds * self.density)
