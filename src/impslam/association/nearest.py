"""The thesis's association: the nearest landmark within fixed gates (4.1.4, 5.2.1, 5.2.2)."""

from __future__ import annotations

import math

import numpy as np

from impslam.association.assignment import collect
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.component import parameter, register
from impslam.types import Mask, Observation


@register("nearest")
class Nearest(Association):
    """Euclidean nearest neighbour: points by distance, walls by feet and angle (thesis)."""

    max_distance: float = parameter(
        2.0, "m", "points (thesis 5.2.1) and feet of walls farther apart are different", gt=0
    )
    max_angle: float = parameter(
        math.radians(30.0),
        "rad",
        "walls that intersect at more are different; 'close to 0 or 180 deg' in thesis 5.2.2",
        gt=0,
    )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Give each observation its nearest landmark; where two want one, the nearer has it."""
        del joint
        return collect(observations, ((group, *self._choose(group)) for group in hypotheses))

    def _choose(self, group: Hypotheses) -> tuple[list[tuple[int, int]], Mask]:
        metres, radians = group.apart()
        allowed = (metres < self.max_distance) & (radians < self.max_angle)
        cost = np.where(allowed, metres, np.inf)
        nearest = cost.argmin(axis=1) if cost.shape[1] else np.zeros(len(cost), np.intp)
        best: dict[int, int] = {}
        for a in np.flatnonzero(allowed.any(axis=1)):
            k = int(nearest[a])
            if k not in best or cost[a, k] < cost[best[k], k]:
                best[k] = int(a)
        return [(a, k) for k, a in best.items()], np.asarray(allowed.any(axis=1))
