"""Medians, means and root mean squares over runs, with how far they can be trusted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from impslam.sweeps.rows import Row
from impslam.types import Array, Ints

MEDIAN_95 = "median [95 %]"
"""How columns of `Quantiles` are headed."""


class Quantiles(NamedTuple):
    """Median and 95 % interval; infinite where what is measured was missing in so many runs.

    By nearest rank, so that a missing landmark counts and is not left out.
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Quantiles:
        """Return the quantiles of some values."""
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
        """Return both in another unit."""
        return Estimate(factor * self.value, factor * self.error)


NONE = Estimate(math.nan, math.nan)


def mean(values: Array | Ints) -> Estimate:
    """Return the mean; NaN of nothing."""
    if not len(values):
        return NONE
    return Estimate(float(values.mean()), float(values.std()) / math.sqrt(len(values)))


def rms(values: Array) -> Estimate:
    """Return the root mean square, its standard error to first order; NaN of nothing."""
    if not len(values):
        return NONE
    squares = np.square(values)
    root = math.sqrt(float(squares.mean()))
    error = float(squares.std()) / math.sqrt(len(squares)) / max(2.0 * root, 1e-300)
    return Estimate(root, error)


Rows = Sequence[Row]


def quantiles_of(metric: str) -> Callable[[Rows], str]:
    """Return a cell of a table: the quantiles of a metric."""
    return lambda rows: str(Quantiles.of(row[metric] for row in rows))


def mean_of(metric: str, form: str = ".2f") -> Callable[[Rows], str]:
    """Return a cell of a table: the mean of a metric; of a list, of its length."""
    return lambda rows: format(float(np.mean([number(row[metric]) for row in rows])), form)


def runs_with(metric: str) -> Callable[[Rows], str]:
    """Return a cell of a table: in how many runs a metric is not 0."""
    return lambda rows: str(sum(number(row[metric]) > 0 for row in rows))


def number(value: float | Sequence[object]) -> float:
    """Return a number, or how many there are in a list."""
    return float(value) if isinstance(value, int | float) else len(value)
