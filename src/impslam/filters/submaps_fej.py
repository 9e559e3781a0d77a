"""Submaps with Jacobians at first estimates: consistent, and at a cost that hardly grows with the map.

`fej` evaluates every Jacobian at an estimate that never changes, so inactive landmarks need no change of
coordinates, unlike in `riekf`, where each correction changes them. It is therefore as exact as `submaps`.
"""

from __future__ import annotations

import numpy as np
from pydantic import PrivateAttr

from impslam.component import register
from impslam.filters.belief import POSE
from impslam.filters.fej import FirstEstimatesEkf
from impslam.filters.submaps import SubmapEkf
from impslam.types import Array, Ints


@register("submaps_fej")
class SubmapFirstEstimatesEkf(SubmapEkf, FirstEstimatesEkf):
    """The first-estimates Jacobian EKF at a cost that hardly grows with the map."""

    _firsts: dict[int, Array] = PrivateAttr(default_factory=dict)
    """Initial states of landmarks, by id."""

    def _keep(self, remaining: Ints) -> None:
        super()._keep(remaining)
        self._first = self._first[remaining]

    def _store(self) -> None:
        """Store the active landmarks and their initial states."""
        super()._store()
        for table in self._atlas.tables():
            self._firsts |= zip(table.ids.tolist(), table.states(self._first), strict=True)

    def _load(self) -> None:
        """Activate the variables of this area, with their initial states."""
        super()._load()
        first = np.zeros(self._belief.n)
        first[:POSE] = self._first[:POSE]
        for table in self._atlas.tables():
            first[table.columns] = [self._firsts[number] for number in table.ids.tolist()]
        self._first = first
