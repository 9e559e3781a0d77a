"""The errors of many runs through the arena, by landmark, and how sure the estimate was of them."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impslam.evaluation.consistency import chi2_bounds
from impslam.studies.arena_print import END
from impslam.studies.arena_runs import ArenaRun, true_landmarks

NAMED = tuple(mark.name for mark in true_landmarks() if mark.kind != "corner")
CORNERS = tuple(mark.name for mark in true_landmarks() if mark.kind == "corner")


@dataclass(frozen=True, slots=True)
class Spread:
    """Median and 95 % interval over seeds, m; infinite where the landmark was missing.

    By nearest rank, so that a missing landmark counts and is not left out.
    """

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of the values."""
        quantiles = np.quantile(values, (0.5, 0.025, 0.975), method="inverted_cdf")
        return cls(*map(float, quantiles))

    def __str__(self) -> str:
        return f"{_metres(self.median)} [{_metres(self.low)}, {_metres(self.high)}]"

    def figures(self) -> dict[str, float | None]:
        """Return plain numbers, None for missing."""
        values = {"median": self.median, "low": self.low, "high": self.high}
        return {name: v if math.isfinite(v) else None for name, v in values.items()}


def _metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "missing"


@dataclass(frozen=True)
class Errors:
    """What came out of one way of mapping, over all seeds.

    Attributes
    ----------
    names : of the landmarks that it is to find
    distance : of points and of the end, and across walls at their middles
    foot : likewise, walls by the distance of the feet of their normals, as the thesis scores them
    missing, false, double : seeds with a landmark that is not in the map, with one where there is
        nothing, and with a second one of something
    corners_missing : seeds in which one of the corners is not in the map
    nees : mean over seeds and scans of the pose's normalised error squared; 3 if consistent
    within : share of scans whose value is below 7.81, as 95 % are to be
    """

    names: tuple[str, ...]
    distance: dict[str, Spread]
    foot: dict[str, Spread]
    missing: tuple[int, ...]
    false: tuple[int, ...]
    double: tuple[int, ...]
    corners_missing: tuple[int, ...]
    nees: float
    within: float

    def figures(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {
            "distance": {name: spread.figures() for name, spread in self.distance.items()},
            "foot": {name: spread.figures() for name, spread in self.foot.items()},
            "seeds_missing": list(self.missing),
            "seeds_false": list(self.false),
            "seeds_double": list(self.double),
            "seeds_corner_missing": list(self.corners_missing),
            "pose_nees": self.nees,
            "pose_nees_within_95": self.within,
        }


def errors(runs: Sequence[ArenaRun], names: Collection[str] = NAMED) -> Errors:
    """Return the errors of runs that are to find the named landmarks."""
    scores = {run.seed: run.score() for run in runs}
    distance: dict[str, list[float]] = {name: [] for name in names}
    foot: dict[str, list[float]] = {name: [] for name in names}
    for score in scores.values():
        found = {error.name: error for error in score.found}
        for name in names:
            distance[name].append(found[name].distance if name in found else math.inf)
            foot[name].append(found[name].foot if name in found else math.inf)
    distance[END] = foot[END] = [run.end for run in runs]
    values = np.concatenate([run.nees for run in runs])
    return Errors(
        tuple(names),
        {name: Spread.of(many) for name, many in distance.items()},
        {name: Spread.of(many) for name, many in foot.items()},
        tuple(seed for seed, score in scores.items() if set(score.missing) & set(names)),
        tuple(seed for seed, score in scores.items() if score.false),
        tuple(seed for seed, score in scores.items() if score.doubles),
        tuple(seed for seed, score in scores.items() if set(score.missing) & set(CORNERS)),
        float(values.mean()),
        float(np.mean(values <= chi2_bounds(3, confidence=0.9)[1])),
    )


def representative(runs: Sequence[ArenaRun]) -> ArenaRun:
    """Return the run whose end is the median one's."""
    return sorted(runs, key=lambda run: run.end)[(len(runs) - 1) // 2]
