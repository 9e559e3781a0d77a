"""The interface of extractors, which find observations in a scan."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from impslam.component import Component, components
from impslam.errors import ConfigError
from impslam.types import Observation, Scan


class Extractor(Component):
    """Finds landmarks of one kind in a scan, without state: same scan and seed, same result."""

    role: ClassVar[str] = "extractor"
    landmark: ClassVar[str] = ""
    """Kind of landmark it finds: "wall", "cylinder", "corner", ... (thesis 5.1, landmarkType)."""

    @cached_property
    def _dims(self) -> Mapping[str, int]:
        """Dimension of an observation, by kind of landmark; the registry takes 0.1 ms to ask."""
        models: Mapping[str, Any] = components("landmark")
        return {kind: model.dim_z for kind, model in models.items()}

    @abstractmethod
    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return the observations in a scan, in the order of the beams.

        `rng` is the random generator of the run, for extractors that sample.
        """

    def observe(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        """Return what `extract` returns, checked, because it may be that of a plug-in.

        Raises
        ------
        ConfigError
            If these are no observations of known landmarks in beams of the scan; otherwise a filter would
            fail later, or worse.
        """
        returned: Any = self.extract(scan, rng)
        found: list[Observation] = []
        if isinstance(returned, Iterable):
            found = list(returned)
            wrong = next(
                filter(None, (_defect(o, self._dims, len(scan.ranges)) for o in found)), ""
            )
        else:
            wrong = f"{type(returned).__name__} in place of a list of observations"
        if wrong:
            raise ConfigError(
                f"extractor {self.name!r} returned {wrong}; correct it, the contract is Extractor in "
                "impslam.extractors.base"
            )
        return found


def _defect(o: Any, dims: Mapping[str, int], n_beams: int) -> str:
    """Return what is wrong with an observation in a scan of `n_beams` beams, or ""."""
    if not isinstance(o, Observation):
        return f"{type(o).__name__} in place of an Observation"
    if (n := dims.get(o.kind)) is None:
        return f"an observation of {o.kind!r}, which is no kind of landmark"
    if getattr(o.z, "shape", None) != (n,) or getattr(o.R, "shape", None) != (n, n):
        return f"a {o.kind} whose z and R are no arrays of shapes ({n},) and ({n}, {n})"
    beams: Any = o.beams
    if not isinstance(beams, np.ndarray) or beams.ndim != 1 or beams.dtype.kind not in "iu":
        return f"a {o.kind} whose beams are no array of integers of shape (any,)"
    if len(beams) and not (beams.min() >= 0 and beams.max() < n_beams):
        return f"a {o.kind} with beams {beams.min()} to {beams.max()} in a scan of {n_beams} beams"
    return ""
