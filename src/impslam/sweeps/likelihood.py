"""Likelihood of a filter's innovations.

Before each correction the filter predicts the matched observations of a scan as one Gaussian,
N(z; h(x), S). The prediction is joint, because the error of the pose affects all of them. The product of
these densities over a run is the likelihood of its noise parameters (Schweppe 1965; Bar-Shalom, Li &
Kirubarajan 2001, 5.4): it is maximal if the innovations are as large as S predicts and S is as small as
possible. If a filter does not provide a joint S, each observation counts by itself, which says less about
the division of noise between motion and sensor.

An observation without a landmark is assumed uniform over the extent of all observations of its kind in the
run. So a narrow gate gains nothing by rejecting observations, and runs with different matches can be
compared: they explain the same observations.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from impslam.map import Keyframe, PathRows, Revision
from impslam.observers.base import Observer
from impslam.types import Array, Match, Observation


class InnovationLikelihood(Observer):
    """Mean negative log-likelihood of the observations of a run."""

    def __init__(self) -> None:
        self._matched, self._matches, self._new = 0.0, 0, Counter[str]()
        self._lowest: dict[str, Array] = {}
        self._highest: dict[str, Array] = {}

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Add the observations of a keyframe and the likelihood of its matches."""
        del path
        for observation in keyframe.observations:
            self._extend(observation)
        self._matched += negative_log_likelihood(revision)
        self._matches += len(revision.matches)
        matched = {match.observation for match in revision.matches}
        self._new.update(o.kind for i, o in enumerate(keyframe.observations) if i not in matched)

    def _extend(self, observation: Observation) -> None:
        kind, z = observation.kind, observation.z
        self._lowest[kind] = np.minimum(self._lowest.get(kind, z), z)
        self._highest[kind] = np.maximum(self._highest.get(kind, z), z)

    @property
    def mean(self) -> float:
        """Nats per observation, of the densities in m and rad; NaN without matches."""
        if not self._matches:
            return math.nan
        new = sum(count * self._extent(kind) for kind, count in self._new.items())
        return (self._matched + new) / (self._matches + self._new.total())

    def _extent(self, kind: str) -> float:
        """Return the logarithm of the volume spanned by the observations of a kind."""
        sides = np.maximum(self._highest[kind] - self._lowest[kind], 1e-9)
        return float(np.log(sides).sum())


def negative_log_likelihood(revision: Revision) -> float:
    """Return the negative log of the density predicted by the filter for a scan's matches."""
    nis, dof = revision.nis()
    joint = revision.innovation
    log_det = sum(map(_log_det, revision.matches)) if joint is None else joint.log_det
    return 0.5 * (nis + log_det + dof * math.log(2.0 * math.pi))


def _log_det(match: Match) -> float:
    return float(np.linalg.slogdet(match.S)[1])
