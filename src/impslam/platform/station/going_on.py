"""A map on the robot's disk, to go on with or to be localised in."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.config import Config, load
from impslam.continuing import Known
from impslam.map import Map
from impslam.open_log import for_continuing
from impslam.platform.station.map_store import FILE
from impslam.types import Array


class GoingOn(NamedTuple):
    """A map by its name, what a run begins with, and the config of that run."""

    name: str
    known: Known
    config: Config

    @property
    def told(self) -> tuple[str, bool]:
        """The name, and whether the map stays as it is."""
        return self.name, self.known.frozen

    def hinted(self, x: float, y: float) -> GoingOn:
        """Return the same, begun about a place in the map, m."""
        return self._replace(known=self.known._replace(hint=np.array([x, y])))


def going_on(folder: Path, preset: str, *, frozen: bool, hint: Array | None = None) -> GoingOn:
    """Return the map of a folder, ready to go on with by a preset.

    An estimator that cannot go on with a map is replaced by `graph`.

    Raises
    ------
    ImpError
        If the map cannot be read.
    """
    return GoingOn(
        folder.name, Known(Map.load(folder / FILE), frozen, hint), for_continuing(load(preset))
    )
