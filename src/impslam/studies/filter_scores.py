"""Scores of filters over the runs of a data set, with intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from impslam.evaluation.consistency import resampled_means
from impslam.studies.filter_consistency import BATCH
from impslam.sweeps.rows import Row, by_variant
from impslam.types import Array


class MeanInterval(NamedTuple):
    """A mean over runs and its 95 % interval."""

    value: float
    low: float
    high: float

    def __format__(self, form: str) -> str:
        return f"{self.value:{form}} [{self.low:{form}}, {self.high:{form}}]"


class FilterScore(NamedTuple):
    """Results of a filter on a data set; NaN for values that are not measured."""

    runs: int
    nees: MeanInterval
    position: MeanInterval  # m
    over_optimum: float
    milliseconds: float
    wrong: float  # share of matches
    megabytes: float


def score_filters(rows: Iterable[Row], data: str) -> dict[str, FilterScore]:
    """Return the results of each filter on a data set."""
    # A filter without a successful run is left out; `failures` reports the reason.
    groups = by_variant(row for row in rows if row["world"] == data and not row["error"])
    best = groups.get(BATCH, ())
    optimum = _rms(best, "position2_at_checks")
    rng = np.random.default_rng(0)
    return {
        name: FilterScore(
            len(runs),
            _interval(_values(runs, "nees"), rng),
            MeanInterval(*np.sqrt(_interval(_values(runs, "position2"), rng))),
            _rms(runs, "position2_at_checks") / optimum,
            float(np.median([run["milliseconds"] for run in runs])),
            _share(runs, "wrong", "matched"),
            max(run.get("megabytes", math.nan) for run in runs),
        )
        for name, runs in groups.items()
    }


def _values(runs: Sequence[Row], metric: str) -> Array:
    """Return the values of a metric in all runs, or in stretches of runs if available."""
    return np.concatenate([run.get(f"{metric}_parts", [run[metric]]) for run in runs])


def _share(runs: Sequence[Row], part: str, whole: str) -> float:
    total = sum(run.get(whole, 0) for run in runs)
    return sum(run.get(part, 0) for run in runs) / total if total else math.nan


def _interval(values: Array, rng: np.random.Generator) -> MeanInterval:
    """Return the mean of values (n,); NaN for n = 0, e.g. of NEES if the truth has no headings."""
    if not len(values):
        return MeanInterval(math.nan, math.nan, math.nan)
    means = resampled_means(values[:, None], rng)[:, 0]
    return MeanInterval(float(values.mean()), *np.quantile(means, [0.025, 0.975]).tolist())


def _rms(rows: Sequence[Row], metric: str) -> float:
    values = [row[metric] for row in rows]
    return math.sqrt(np.mean(values)) if values else math.nan
