"""The thesis's association: the nearest landmark within fixed gates (4.1.4, 5.2.1, 5.2.2)."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from impslam.association.assignment import make_assignment
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.component import parameter, register
from impslam.types import Observation


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
    directed: bool = parameter(
        False, "", "distinguish walls seen from opposite sides; the thesis treats 180 deg as 0"
    )
    frame: Literal["map", "base_link"] = parameter(
        "map",
        "",
        "frame of the comparison: map (thesis 4.2.6), in which the feet of walls move by heading "
        "error times distance from the origin, or base_link, as seen from the robot (thesis 2.1.3)",
    )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Match each observation with its nearest landmark; of two with the same, the nearer one wins."""
        del joint
        return make_assignment(
            observations, ((group, *self._choose(group)) for group in hypotheses)
        )

    def _choose(self, group: Hypotheses) -> tuple[list[int], list[int]]:
        metres, radians = group.distances(self.frame == "base_link")
        if not self.directed:
            radians = np.minimum(radians, math.pi - radians)
        allowed = (metres < self.max_distance) & (radians < self.max_angle)
        near = np.flatnonzero(allowed).tolist()
        nearest: dict[int, int] = {}  # pairs, by observation, then by landmark
        best: dict[int, int] = {}
        for p in near:
            rival = nearest.setdefault(int(group.observations[p]), p)
            if metres[p] < metres[rival]:
                nearest[int(group.observations[p])] = p
        for p in nearest.values():
            rival = best.setdefault(int(group.landmarks[p]), p)
            if metres[p] < metres[rival]:
                best[int(group.landmarks[p])] = p
        return list(best.values()), near
