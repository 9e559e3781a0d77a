"""A map on the robot's disk that a run continues, or localises in."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.config import Config, load
from impslam.continuing import KnownMap
from impslam.map import Map
from impslam.open_log import for_continuing
from impslam.platform.station.map_store import FILE


class ContinuedMap(NamedTuple):
    """The name of a map, the map that a run begins with, and the config of that run."""

    name: str
    known: KnownMap
    config: Config

    def with_hint(self, x: float, y: float) -> ContinuedMap:
        """Return a copy whose run begins near a position in the map, m."""
        return self._replace(known=self.known._replace(hint=np.array([x, y])))


def load_continued_map(folder: Path, preset: str, *, frozen: bool) -> ContinuedMap:
    """Load the map of a folder, to be continued with a preset.

    An estimator that cannot continue a map is replaced by `graph`.

    Raises
    ------
    ImpError
        If the map cannot be read.
    """
    known = KnownMap(Map.load(folder / FILE), frozen)
    return ContinuedMap(folder.name, known, for_continuing(load(preset)))
