"""What filters with one Gaussian over pose and landmarks share: the books, and how much R counts.

Sensors that now and then err by many sigmas have noise with heavy tails: Student's t, a Gaussian whose
covariance R / w is itself unsure, w drawn from a gamma distribution of mean 1. Given the innovation,
E[w] = (nu + k) / (nu + d^2) for k measured scalars and nu degrees of freedom (Agamennoni, Nieto & Nebot
2012, Eq. 13 with the innovation's d^2), so that an outlier's R grows with its d^2 and its pull vanishes.

Errors that repeat from one observation of a landmark to the next, as views and calibrations do, count
once in so many observations: with a correlation of exp(-x / L) between those taken x apart, observations
every x are worth x / (2 L) of independent ones. Corrections then use a multiple of R; association, which
judges each observation alone, uses R itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import log_normal
from impslam.component import parameter
from impslam.filters.atlas import Atlas
from impslam.filters.base import Filter
from impslam.filters.belief import POSE, Belief
from impslam.types import Array, Ints, Landmark, Match, Observation

INDEFINITE = (
    "the innovations' covariance is not positive definite: check the noise of the sensors and of the "
    "odometry (sigma, bias, ...)"
)
"""What a correction says that is refused."""


class GaussianFilter(Filter):
    """A filter whose belief is one Gaussian."""

    tails: float = parameter(
        0.0,
        "1",
        "degrees of freedom of the measurement noise (4: heavy tails, outliers fade); 0: Gaussian",
        ge=0,
    )
    repeats: float = parameter(
        1.0, "1", "observations of a landmark that share one error, so that each counts less", ge=1
    )
    _belief: Belief = PrivateAttr()
    _atlas: Atlas = PrivateAttr()

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks out: their rows and columns go, the rest stays as it is."""
        if ids:
            self._belief.keep(self._atlas.remove(ids, self._belief.n))

    def note(
        self, observations: Sequence[Observation], matches: Sequence[Match], stamp: float
    ) -> None:
        """Keep the books of the matched landmarks."""
        self._atlas.note(self.pose, self._belief.mean, observations, matches, stamp)

    def log_densities(
        self, observations: Sequence[Observation], matches: Sequence[Match], *, alone: bool = False
    ) -> Array:
        """Return those of Student's t with `tails`, else of the Gaussian; R counts `repeats` times."""
        more = 0.0 if alone else self.repeats - 1.0
        noises = (more * observations[match.observation].R for match in matches)
        return np.array([self._log_density(*pair) for pair in zip(matches, noises, strict=True)])

    def _log_density(self, match: Match, more: Array) -> float:
        S, k = match.S + more, len(match.S)
        distance2 = float(match.innovation @ np.linalg.solve(S, match.innovation))
        if not self.tails:
            return log_normal(distance2, S)
        degrees, most = self.tails, 0.5 * (self.tails + k)
        scale = math.lgamma(most) - math.lgamma(0.5 * degrees)
        scale -= 0.5 * float(np.linalg.slogdet(degrees * math.pi * S)[1])
        return scale - most * math.log1p(distance2 / degrees)

    @property
    def pose(self) -> Array:
        """`T_map_base` (3,)."""
        return self._belief.mean[:POSE].copy()

    @property
    def covariance(self) -> Array:
        """(3, 3) of the pose."""
        return self._belief.pose_covariance()

    @property
    def belief(self) -> Belief:
        """The joint belief, for tests and for the study of consistency; read only."""
        return self._belief

    def outlines(self) -> tuple[Ints, Array]:
        """Return the ids (k,) of all landmarks and their visible ends (k, 2, 2) in map."""
        return self._atlas.outlines(self._belief.mean)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the map in the form users read."""
        return self._atlas.landmarks(self._belief)

    @property
    def state_size(self) -> int:
        """Number of scalars that are estimated."""
        return self._belief.n - len(self._belief.errors)

    def doubt(self, matches: Sequence[Match]) -> Array | None:
        """Return how many times R counts (matches,) for repetition and innovations; None: once.

        The latter once, by the belief before the correction: its S tells what is far off from what is
        merely unknown yet, and given these R the correction is Gaussian, its covariance as good as
        ever. No R shrinks: that an innovation is small by chance does not make a sensor better.
        """
        if not self.tails and self.repeats == 1.0:
            return None
        if not self.tails:
            return np.full(len(matches), self.repeats)
        distance2, k = np.array([(match.distance2, len(match.innovation)) for match in matches]).T
        doubt: Array = np.maximum(1.0, (self.tails + distance2) / (self.tails + k))
        return self.repeats * doubt
