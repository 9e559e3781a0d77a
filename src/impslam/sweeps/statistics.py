"""Medians, means and root mean squares over runs, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from impslam.sweeps.rows import Row
from impslam.types import Array, Ints

MEDIAN_95 = "median [95 %]"
"""Heading of columns of `Quantiles`."""


class Quantiles(NamedTuple):
    """Median and 95 % interval, by nearest rank; infinite if too many runs miss the value.

    A missing landmark counts as an infinite error and is not left out.
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Quantiles:
        """Return the quantiles of values."""
        known = np.array(list(values), dtype=np.float64)
        quantiles = np.quantile(known, (0.5, 0.025, 0.975), method="inverted_cdf")
        return cls(*map(float, quantiles))

    def __str__(self) -> str:
        median, low, high = (f"{v:.3f}" if math.isfinite(v) else "missing" for v in self)
        return f"{median} [{low}, {high}]"


class Estimate(NamedTuple):
    """A number and its standard error."""

    value: float
    error: float

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate in another unit."""
        return Estimate(factor * self.value, factor * self.error)


NONE = Estimate(math.nan, math.nan)


def mean(values: Array | Ints) -> Estimate:
    """Return the mean; NaN without values."""
    if not len(values):
        return NONE
    return Estimate(float(values.mean()), _standard_error(values))


def rms(values: Array) -> Estimate:
    """Return the root mean square of values (n,), with its first-order standard error; NaN for n = 0."""
    if not len(values):
        return NONE
    squares = np.square(values)
    root = math.sqrt(float(squares.mean()))
    return Estimate(root, _standard_error(squares) / max(2.0 * root, 1e-300))


def _standard_error(values: Array | Ints) -> float:
    """Return the standard error of the mean of values (n,); NaN for n = 1."""
    if len(values) < 2:
        return math.nan
    return float(values.std(ddof=1)) / math.sqrt(len(values))


Rows = Sequence[Row]


def quantiles_of(metric: str) -> Callable[[Rows], str]:
    """Return a function for a table cell: the quantiles of a metric."""
    return lambda rows: str(Quantiles.of(row[metric] for row in rows))


def mean_of(metric: str, form: str = ".2f") -> Callable[[Rows], str]:
    """Return a function for a table cell: the mean of a metric, or of the lengths of lists."""
    return lambda rows: format(float(np.mean([number(row[metric]) for row in rows])), form)


def runs_with(metric: str) -> Callable[[Rows], str]:
    """Return a function for a table cell: the number of runs with a positive metric."""
    return lambda rows: str(sum(number(row[metric]) > 0 for row in rows))


def number(value: float | Sequence[object]) -> float:
    """Return a number, or the length of a list."""
    return float(value) if isinstance(value, int | float) else len(value)
