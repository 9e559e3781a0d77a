"""Common base of filters with one Gaussian over pose and landmarks: bookkeeping, and noise factors.

Sensors with occasional errors of many sigmas have heavy-tailed noise: Student's t, i.e. a Gaussian with the
random covariance R / w, with w from a gamma distribution of mean 1. Given the innovation,
E[w] = (nu + k) / (nu + d^2) for k measured scalars and nu degrees of freedom (Agamennoni, Nieto & Nebot
2012, Eq. 13 with the innovation's d^2), so that an outlier's R grows with its d^2 and its effect vanishes.

Errors that repeat between observations of a landmark, e.g. due to viewpoint or calibration, reduce the
information: with a correlation of exp(-x / L) at a distance x, each observation counts as x / (2 L) of an
independent one. Corrections then use a multiple of R; association, which considers each observation
independently, uses R itself.
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
"""Error message of a correction."""


class GaussianFilter(Filter):
    """A filter whose belief is one Gaussian."""

    dof: float = parameter(
        0.0,
        "1",
        "degrees of freedom of the measurement noise (Student's t; 4: outliers have little weight); 0: "
        "Gaussian",
        ge=0,
    )
    repeats: float = parameter(
        1.0,
        "1",
        "number of observations of a landmark with one common error; R is multiplied by it",
        ge=1,
    )
    _belief: Belief = PrivateAttr()
    _atlas: Atlas = PrivateAttr()

    def remove(self, ids: Sequence[int]) -> None:
        """Marginalise landmarks out by removing their rows and columns."""
        if ids:
            self._belief.keep(self._atlas.remove(ids, self._belief.n))

    def note(
        self, observations: Sequence[Observation], matches: Sequence[Match], stamp: float
    ) -> None:
        """Update extents, counts and attributes of the matched landmarks."""
        self._atlas.note(self.pose, self._belief.mean, observations, matches, stamp)

    def log_densities(
        self, observations: Sequence[Observation], matches: Sequence[Match], *, alone: bool = False
    ) -> Array:
        """Return densities of Student's t with `dof`, else of the Gaussian, with `repeats` times R."""
        factor = 0.0 if alone else self.repeats - 1.0
        noises = (factor * observations[match.observation].R for match in matches)
        return np.array([self._log_density(*pair) for pair in zip(matches, noises, strict=True)])

    def _log_density(self, match: Match, noise: Array) -> float:
        S, k = match.S + noise, len(match.S)
        distance2 = float(match.innovation @ np.linalg.solve(S, match.innovation))
        if not self.dof:
            return log_normal(distance2, S)
        degrees, power = self.dof, 0.5 * (self.dof + k)
        scale = math.lgamma(power) - math.lgamma(0.5 * degrees)
        scale -= 0.5 * float(np.linalg.slogdet(degrees * math.pi * S)[1])
        return scale - power * math.log1p(distance2 / degrees)

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
        """The joint belief, read-only, for tests and studies of consistency."""
        return self._belief

    def outlines(self) -> tuple[Ints, Array]:
        """Return the ids (k,) of all landmarks and their visible ends (k, 2, 2) in map."""
        return self._atlas.outlines(self._belief.mean)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`."""
        return self._atlas.landmarks(self._belief)

    def landmark_covariance(self) -> Array:
        """Return the joint covariance (2 k, 2 k) of the landmarks, in their order."""
        mean = self._belief.mean
        half = self._atlas.in_values(mean, self._belief.covariance)
        return self._atlas.in_values(mean, half.T)

    @property
    def state_size(self) -> int:
        """Number of estimated scalars."""
        return self._belief.n - len(self._belief.errors)

    def noise_factors(self, matches: Sequence[Match]) -> Array | None:
        """Return factors (matches,) of R for repeated errors and heavy tails; None: all 1.

        The latter are computed once, from the belief before the correction: its S distinguishes outliers
        from large innovations of an uncertain state. With these R the correction is Gaussian. Factors are
        at least 1, because a small innovation by chance does not make a sensor more accurate.
        """
        if not self.dof and self.repeats == 1.0:
            return None
        if not self.dof:
            return np.full(len(matches), self.repeats)
        distance2, k = np.array([(match.distance2, len(match.innovation)) for match in matches]).T
        factors: Array = np.maximum(1.0, (self.dof + distance2) / (self.dof + k))
        return self.repeats * factors
