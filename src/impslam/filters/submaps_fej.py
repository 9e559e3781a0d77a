"""Submaps with Jacobians at first estimates: consistent, and at a cost that hardly grows with the map.

`fej` evaluates every Jacobian at an estimate that never changes, so that landmarks which are not handled
need no change of coordinates, as those of `riekf` do at each correction. So it is as exact as `submaps`.
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
    """Of each landmark the state that it was entered with, by id."""

    def _keep(self, stays: Ints) -> None:
        super()._keep(stays)
        self._first = self._first[stays]

    def _store(self) -> None:
        """Keep what tables hold, and first states."""
        super()._store()
        for table in self._atlas.tables():
            self._firsts |= zip(table.ids.tolist(), table.states(self._first), strict=True)

    def _load(self) -> None:
        """Handle the variables of this area, with their first states."""
        super()._load()
        first = np.zeros(self._belief.n)
        first[:POSE] = self._first[:POSE]
        for table in self._atlas.tables():
            first[table.columns] = [self._firsts[number] for number in table.ids.tolist()]
        self._first = first
