"""What judged scans say of an extractor: rates, and errors against their bounds, with their errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from impslam.studies.extractor_scores import Counts, Found
from impslam.types import Array, Ints

_MEDIAN = float(chi2.ppf(0.5, 2))
"""Median of the squared normalised error of two Gaussian parameters that keep the bound."""


@dataclass(frozen=True)
class Tally:
    """All scans of one extractor under one condition.

    Attributes
    ----------
    counts : (n, 7) of each scan, the columns of `Counts`
    found : what was found in all of them
    """

    counts: Ints
    found: Sequence[Found]

    @staticmethod
    def of(judged: Sequence[tuple[Counts, list[Found]]]) -> Tally:
        """Return the tally of some scans."""
        counts = np.array([c for c, _ in judged], np.int64).reshape(-1, len(Counts._fields))
        return Tally(counts, [f for _, found in judged for f in found])

    def __add__(self, other: Tally) -> Tally:
        """Return the tally of the scans of both."""
        return Tally(np.vstack((self.counts, other.counts)), [*self.found, *other.found])

    def rate(self, what: str) -> tuple[float, float]:
        """Return how many of the `Counts` there are in a scan, and the standard error of it."""
        column = self.counts[:, Counts._fields.index(what)]
        return float(column.mean()), float(column.std() / math.sqrt(len(column)))

    @property
    def true_positives(self) -> tuple[float, float]:
        """Share of the visible landmarks that was found, and the standard error over scans."""
        return self._share("visible", "found")

    @property
    def whole_found(self) -> tuple[float, float]:
        """Share of the landmarks seen from edge to edge that was found; NaN where there are none."""
        return self._share("whole", "whole_found")

    def _share(self, of: str, what: str) -> tuple[float, float]:
        there, found = (self.counts[:, Counts._fields.index(name)] for name in (of, what))
        total = int(there.sum())
        if not total:
            return math.nan, math.nan
        share = float(found.sum()) / total
        return share, float(np.sqrt(np.sum((found - share * there) ** 2))) / total

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
        """Squared errors in the covariances that the extractor itself gives, (m,); ideal mean 2."""
        return _normalised(self.errors, np.array([f.R for f in self.found]).reshape(-1, 2, 2))

    @cached_property
    def excess(self) -> Array:
        """Squared errors in the Cramér-Rao bounds, (m,); at least 2 on average."""
        return _normalised(self.errors, self.bounds)

    @property
    def beams(self) -> Ints:
        """How many beams hit each landmark that was found, (m,)."""
        return np.array([f.beams for f in self.found], np.int64)

    def column(self, name: str) -> Array:
        """Return one number of each landmark that was found, (m,), where it has one."""
        values = np.array([getattr(f, name) for f in self.found], np.float64)
        return np.asarray(values[np.isfinite(values)])

    def ratio(self, k: int) -> tuple[float, float]:
        """Return RMS error over bound of the k-th of z, and its standard error."""
        return rms(self.errors[:, k] / np.sqrt(self.bounds[:, k, k]))

    @property
    def joint_ratio(self) -> tuple[float, float]:
        """RMS error over bound of z as a whole, and its standard error."""
        return rms(np.sqrt(0.5 * self.excess))

    @property
    def own_ratio(self) -> tuple[float, float]:
        """RMS error over the bound of the beams that the observation itself rests on."""
        return rms(np.sqrt(0.5 * self.column("own_excess")))

    @property
    def radius_ratio(self) -> tuple[float, float]:
        """RMS error over bound of the radius, and its standard error."""
        return rms(self.column("radius_error") / np.sqrt(self.column("radius_bound")))


def typical_ratio(excess: Array) -> float:
    """Return the median error over that of an efficient estimator; 1 at the bound.

    Unlike the RMS it does not show the few that went wrong.
    """
    return math.sqrt(float(np.median(excess)) / _MEDIAN) if len(excess) else math.nan


def rms(values: Array) -> tuple[float, float]:
    """Return the root mean square and its standard error, to first order; NaN of nothing."""
    if not len(values):
        return math.nan, math.nan
    squares = np.square(values)
    root = math.sqrt(float(squares.mean()))
    return root, float(squares.std()) / math.sqrt(len(squares)) / max(2.0 * root, 1e-300)


def mean(values: Array) -> tuple[float, float]:
    """Return the mean and its standard error; NaN of nothing."""
    if not len(values):
        return math.nan, math.nan
    return float(values.mean()), float(values.std()) / math.sqrt(len(values))


def _normalised(errors: Array, covariances: Array) -> Array:
    if not len(errors):
        return np.empty(0)
    scaled = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return np.asarray((errors * scaled).sum(axis=1))
