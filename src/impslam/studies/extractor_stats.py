"""An extractor's score over many scans: rates, and errors against their bounds, with standard errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from impslam.evaluation.consistency import nees
from impslam.studies.extractor_scores import Counts, Detection
from impslam.sweeps.statistics import NONE, Estimate, mean, rms
from impslam.types import Array, Ints

_MEDIAN = float(chi2.ppf(0.5, 2))
"""Median of the squared normalised error of two Gaussian parameters that keep the bound."""


@dataclass(frozen=True)
class ExtractorScore:
    """All scans of one extractor under one condition.

    Attributes
    ----------
    counts : (n, 7) of each scan, the columns of `Counts`
    found : what was found in all of them
    """

    counts: Ints
    found: Sequence[Detection]

    @staticmethod
    def of(scored: Sequence[tuple[Counts, list[Detection]]]) -> ExtractorScore:
        """Return the score of some scans."""
        counts = np.array([c for c, _ in scored], np.int64).reshape(-1, len(Counts._fields))
        return ExtractorScore(counts, [f for _, found in scored for f in found])

    def __add__(self, other: ExtractorScore) -> ExtractorScore:
        """Return the score of the scans of both."""
        return ExtractorScore(np.vstack((self.counts, other.counts)), [*self.found, *other.found])

    def rate(self, what: str) -> Estimate:
        """Return the mean of one of the `Counts` per scan, with its standard error."""
        return mean(self.counts[:, Counts._fields.index(what)])

    @property
    def true_positives(self) -> Estimate:
        """Share of the visible landmarks that were found, with the standard error over scans."""
        return self._share("visible", "found")

    @property
    def whole_found(self) -> Estimate:
        """Share of the landmarks visible from edge to edge that were found; NaN without any."""
        return self._share("whole", "whole_found")

    def _share(self, of: str, what: str) -> Estimate:
        there, found = (self.counts[:, Counts._fields.index(name)] for name in (of, what))
        total = int(there.sum())
        if not total:
            return NONE
        share = float(found.sum()) / total
        error = float(np.sqrt(np.sum((found - share * there) ** 2))) / total
        return Estimate(share, error)

    @cached_property
    def errors(self) -> Array:
        """Errors of z, (m, 2)."""
        return np.array([f.error for f in self.found]).reshape(-1, 2)

    @cached_property
    def bounds(self) -> Array:
        """Their Cramér-Rao bounds, (m, 2, 2)."""
        return np.array([f.bound for f in self.found]).reshape(-1, 2, 2)

    @cached_property
    def nees(self) -> Array:
        """Squared errors normalised by the extractor's own covariances, (m,); ideal mean 2."""
        return nees(self.errors, np.array([f.R for f in self.found]).reshape(-1, 2, 2))

    @cached_property
    def excess(self) -> Array:
        """Squared errors normalised by the Cramér-Rao bounds, (m,); at least 2 on average."""
        return nees(self.errors, self.bounds)

    @property
    def beams(self) -> Ints:
        """Number of beams that hit each found landmark, (m,)."""
        return np.array([f.beams for f in self.found], np.int64)

    def column(self, name: str) -> Array:
        """Return the finite values (m,) of a field of `Detection` for the found landmarks."""
        values = np.array([getattr(f, name) for f in self.found], np.float64)
        return np.asarray(values[np.isfinite(values)])

    def metrics(self) -> dict[str, Estimate]:
        """Return the errors of found landmarks by name, in m and rad; empty if there are none.

        `bias_k` and `rms_k` are those of z[k], `ratio_k` is its RMS over the bound, `ratio` that of z as a
        whole, `own_ratio` the same over the bound for the beams that the observation itself uses. For
        cylinders, `radial_bias` is along the line of sight and `rms` is of the centre; `radius_*` exist if
        the radius is measured.
        """
        if not self.found:
            return {}
        z, bounds = self.errors, self.bounds
        found = {f"bias_{k}": mean(z[:, k]) for k in (0, 1)}
        found |= {f"rms_{k}": rms(z[:, k]) for k in (0, 1)}
        found |= {f"ratio_{k}": rms(z[:, k] / np.sqrt(bounds[:, k, k])) for k in (0, 1)}
        found["ratio"] = rms(np.sqrt(0.5 * self.excess))
        found["own_ratio"] = rms(np.sqrt(0.5 * self.column("own_excess")))
        found["nees"] = mean(self.nees)
        found["beams_used"] = mean(self.column("used"))
        if len(radial := self.column("radial")):
            found |= {"radial_bias": mean(radial), "rms": rms(np.hypot(*z.T))}
        if len(radius := self.column("radius_error")):
            ratio = rms(radius / np.sqrt(self.column("radius_bound")))
            found |= {"radius_bias": mean(radius), "radius_rms": rms(radius), "radius_ratio": ratio}
        return found


def typical_ratio(excess: Array) -> float:
    """Return the median error over that of an efficient estimator; 1 at the bound.

    Unlike the RMS it is robust against outliers.
    """
    return math.sqrt(float(np.median(excess)) / _MEDIAN) if len(excess) else math.nan
