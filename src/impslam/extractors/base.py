"""The interface of extractors, which find observations in a scan."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from impslam.component import Component
from impslam.types import Observation, Scan


class Extractor(Component):
    """Finds landmarks of one kind in a scan, without state: same scan and seed, same result."""

    role: ClassVar[str] = "extractor"
    landmark: ClassVar[str] = ""
    """Kind of landmark it finds: "wall", "cylinder", "corner", ... (thesis 5.1, landmarkType)."""

    @abstractmethod
    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the observations in a scan, in the order of the beams.

        `rng` is the random generator of the run, for extractors that sample.
        """
