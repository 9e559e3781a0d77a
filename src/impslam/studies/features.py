"""Points, lines, or both: the thesis's comparison across its Tables 1 to 3 (5.2.3), seed by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from impslam.studies.arena_experiment import END, TEXT, Experiment, landmark_metrics
from impslam.studies.arena_seeds import MIN_DRIFT, drifting_seeds
from impslam.studies.arena_tables import actual
from impslam.studies.report import ResultTable, Section, load_text
from impslam.studies.sweep import Variant, sweep
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row, by_variant, failures
from impslam.types import Array

SEEDS = 10
"""Default, for a quick look; published results use 100."""
DRAWS = 10_000
"""Bootstrap samples: 250 are beyond each end of the interval."""
KINDS = ("points", "lines", "both")


class Comparison(NamedTuple):
    """A comparison of the thesis: errors of landmarks or of the end, with both features and with one."""

    what: str
    names: tuple[str, ...]
    with_one: str
    as_printed: float  # %, from the squares of the tables


class Gain(NamedTuple):
    """Reduction of errors with both kinds: a share, its 95 % interval, and the share of better seeds."""

    share: float
    low: float
    high: float
    better: float


def features(job: Job) -> Section:
    """Compare the three ways to map on the same drives."""
    text = load_text("features")
    seeds = drifting_seeds(job, job.seeds or SEEDS)
    variants = [Variant(kind, f"thesis-{kind}") for kind in KINDS]
    rows = sweep(variants, seeds, measure=landmark_metrics, job=job)
    runs = {kind: {row["seed"]: row for row in found} for kind, found in by_variant(rows).items()}
    gains = {comparison: _gain(comparison, runs) for comparison in _comparisons(text)}
    cells = [
        [
            c.what,
            f"{c.as_printed:+.1f}",
            f"{100.0 * _printed(c):+.0f}",
            _format(gain),
            f"{100 * gain.better:.0f}",
        ]
        for c, gain in gains.items()
    ]
    table = ResultTable(text["table"], text["header"], cells, 1, text["note"])
    numbers = {c.what: [*gain] for c, gain in gains.items()} | {"seeds": list(seeds)}
    words = text["text"].format(count=len(seeds), off=MIN_DRIFT)
    words = "\n\n".join(filter(None, (words, failures(rows))))
    return Section("features", text["title"], words, [table], (), numbers, rows)


def _comparisons(text: Mapping[str, Mapping[str, float]]) -> list[Comparison]:
    cylinders, walls = (Experiment.load(kind).names for kind in ("points", "lines"))
    printed = text["printed"]
    return [
        Comparison("cylinders, against points", cylinders, "points", printed["cylinders"]),
        Comparison("walls, against lines", walls, "lines", printed["walls"]),
        Comparison("end, against points", (END,), "points", printed["end_points"]),
        Comparison("end, against lines", (END,), "lines", printed["end_lines"]),
    ]


def _printed(comparison: Comparison) -> float:
    """Return the reduction of the printed distances (not their squares) with both kinds."""

    def total(kind: str) -> float:
        at: Mapping[str, Sequence[float]] = TEXT[kind]["printed"]
        return sum(float(np.hypot(*(actual(n) - np.array(at[n])))) for n in comparison.names)

    return 1.0 - total("both") / total(comparison.with_one)


def _gain(comparison: Comparison, runs: Mapping[str, Mapping[int, Row]]) -> Gain:
    """Return the gain in the mean over landmarks and seeds; a missing landmark counts as infinite."""
    seeds = sorted(runs["both"].keys() & runs[comparison.with_one].keys())

    def errors(kind: str) -> Array:
        """Return the mean errors (n,) m over the landmarks, as in the thesis (walls by feet)."""
        return np.array([
            np.mean([runs[kind][seed][f"foot {name}"] for name in comparison.names])
            for seed in seeds
        ])  # fmt: skip

    one, both = errors(comparison.with_one), errors("both")
    return Gain(*_bootstrapped(one, both), float(np.mean(both < one)))


def _bootstrapped(one: Array, both: Array) -> tuple[float, float, float]:
    """Return 1 - both / one of paired means, and percentiles of its bootstrap over seeds (Efron 1979)."""
    picks = np.random.default_rng(0).integers(0, len(one), (DRAWS, len(one)))
    with np.errstate(invalid="ignore"):  # a landmark that both miss is not a gain
        drawn = 1.0 - both[picks].mean(axis=1) / one[picks].mean(axis=1)
        whole = 1.0 - both.mean() / one.mean()
    drawn, whole = (np.nan_to_num(x, nan=-np.inf, neginf=-np.inf) for x in (drawn, whole))
    low, high = np.quantile(drawn, (0.025, 0.975), method="inverted_cdf").tolist()
    return float(whole), low, high


def _format(gain: Gain) -> str:
    return f"{100 * gain.share:+.0f} [{100 * gain.low:+.0f}, {100 * gain.high:+.0f}]"
