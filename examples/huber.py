"""A filter in one file: the EKF with weights that fall with an observation's distance.

A match whose squared Mahalanobis distance d^2 exceeds k^2 per degree of freedom is taken in with its
covariance R multiplied by d / k: an outlier then pulls no harder than an observation at k sigma
(Huber 1964; Zhang 1997 for its use as weights).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impslam.component import parameter, register
from impslam.filters.ekf import Ekf
from impslam.types import Match, Observation


@register("huber")
class HuberEkf(Ekf):
    """The EKF, robust against matches that pass the gate and are wrong."""

    k: float = parameter(1.345, "1", "sigmas from which on weights fall (95 % efficient)", gt=0.0)

    def correct(self, observations: Sequence[Observation], matches: Sequence[Match]) -> None:
        """Take all matches of a scan in, each with its weight."""
        weighted = list(observations)
        for match in matches:
            sigmas = np.sqrt(match.distance2 / len(match.innovation))
            seen = weighted[match.observation]
            weighted[match.observation] = replace(seen, R=max(1.0, sigmas / self.k) * seen.R)
        super().correct(weighted, matches)
