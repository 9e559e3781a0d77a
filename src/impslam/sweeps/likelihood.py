"""How well a filter foretells what its sensors see: the likelihood of the innovations.

Before each correction the filter predicts the matched observations of a scan as one Gaussian,
N(z; h(x), S): jointly, for the error of the pose is in all of them, and only what they do not share
is the sensor's. The product of these densities over a run is the likelihood of its noise parameters
(Schweppe 1965; Bar-Shalom, Li & Kirubarajan 2001, 5.4): its maximum is where the innovations are as
large as S says, and S is no larger than it need be. A filter that does not tell S jointly is judged
observation by observation, which says less of how noise divides between motion and sensor.

An observation that belongs to no landmark is taken as uniform over all that observations of its kind
were in this run. So a narrow gate gains nothing by what it refuses, and runs that match differently
can be compared: they explain the same observations.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from impslam.map import Keyframe, PathRows, Revision
from impslam.observers.base import Observer
from impslam.types import Array, Match, Observation


class Surprise(Observer):
    """Mean negative log-likelihood of the observations of a run."""

    def __init__(self) -> None:
        self._matched, self._matches, self._new = 0.0, 0, Counter[str]()
        self._lowest: dict[str, Array] = {}
        self._highest: dict[str, Array] = {}

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Take in what a keyframe saw, and how well it was foretold."""
        del path
        for observation in keyframe.observations:
            self._see(observation)
        self._matched += surprise(revision)
        self._matches += len(revision.matches)
        matched = {match.observation for match in revision.matches}
        self._new.update(o.kind for i, o in enumerate(keyframe.observations) if i not in matched)

    def _see(self, observation: Observation) -> None:
        kind, z = observation.kind, observation.z
        self._lowest[kind] = np.minimum(self._lowest.get(kind, z), z)
        self._highest[kind] = np.maximum(self._highest.get(kind, z), z)

    @property
    def mean(self) -> float:
        """Nats per observation, of the densities in m and rad; NaN where nothing was matched."""
        if not self._matches:
            return math.nan
        new = sum(count * self._extent(kind) for kind, count in self._new.items())
        return (self._matched + new) / (self._matches + self._new.total())

    def _extent(self, kind: str) -> float:
        """Return the logarithm of the volume in which the observations of a kind were."""
        sides = np.maximum(self._highest[kind] - self._lowest[kind], 1e-9)
        return float(np.log(sides).sum())


def surprise(revision: Revision) -> float:
    """Return the negative logarithm of the density of a scan's matches, as the filter foretold them."""
    nis, dof = revision.nis()
    told = revision.innovation
    log_det = sum(map(_log_det, revision.matches)) if told is None else told.log_det
    return 0.5 * (nis + log_det + dof * math.log(2.0 * math.pi))


def _log_det(match: Match) -> float:
    return float(np.linalg.slogdet(match.S)[1])
