"""The role of an extractor: a scan in, observations out."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from impslam.component import Component
from impslam.types import Observation, Scan


class Extractor(Component):
    """Finds landmarks of one kind in a scan. Stateless: same scan and seed, same answer."""

    role: ClassVar[str] = "extractor"
    landmark: ClassVar[str] = ""
    """Kind of landmark it finds: "wall", "cylinder", "corner", ... (thesis 5.1, landmarkType)."""

    @abstractmethod
    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return what the scan shows, in the order of the beams.

        `rng` is the run's own generator, for extractors that sample; others ignore it.
        """
