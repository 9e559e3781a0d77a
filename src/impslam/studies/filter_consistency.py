"""Monte Carlo study of the consistency and the efficiency of filters.

Every filter runs on the same data (see `circle_simulation`). The results are:

- the normalised error squared (NEES) of the pose, ideally 3, over all runs and steps, and the share of
  steps at which its mean over the runs is within the 95 % interval of a consistent filter. Steps of a run
  are strongly correlated because the heading error of the first step persists: its mean square over the
  runs, `first_turn`, ideally 1, scatters by sqrt(2 / runs) and shifts all steps alike. So the share is 95 %
  on average over studies, not in each;
- 95 % intervals of these values by the bootstrap over runs;
- at check points, the NEES of landmarks (ideally 2) and the normalised innovation squared of a whole
  scan over its dimension (NIS, ideally 1);
- the root mean square errors (RMSE) of position and heading, and their ratio to the batch optimum's of
  the same data up to the same step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.component import build
from impslam.evaluation.consistency import nees, pose_errors, resampled_means, share_within
from impslam.filters.base import Filter
from impslam.studies.batch_optimum import optima
from impslam.studies.circle_simulation import HUANG, START_SIGMA, Setting, Trial, simulate
from impslam.sweeps.job import Job
from impslam.types import Array, Increment, Match, Observation

Run: TypeAlias = tuple[Array, float]
"""Values (estimators, 6, steps) of one run, and its first turn."""
BATCH = "batch optimum"
CHECK_EVERY = 40
"""Steps between check points: a batch optimum costs as much as 30 steps of a filter."""


class Curves(NamedTuple):
    """One estimator's means over the runs, by step: (steps,) each, NaN where not evaluated.

    `nees` is the pose's, `position` the RMSE in m, `heading` in rad; `nees_landmarks` and `nis` at check
    points only, as is `apart`, the root mean square distance from the batch optimum, m.
    """

    nees: Array
    position: Array
    heading: Array
    nees_landmarks: Array
    nis: Array
    apart: Array


Interval: TypeAlias = tuple[float, float]


class Intervals(NamedTuple):
    """The 95 % intervals of some values of a row, by the bootstrap over runs."""

    nees: Interval
    in_band: Interval
    position: Interval  # m
    heading: Interval  # rad


@dataclass(frozen=True, slots=True)
class FilterResult:
    """One estimator's values over all steps; the ratios are at check points."""

    name: str
    nees: float
    in_band: float
    nees_landmarks: float
    nis: float
    position: float  # m
    heading: float  # rad
    position_ratio: float
    heading_ratio: float
    apart: float  # m
    spread: Intervals


@dataclass(frozen=True, slots=True, eq=False)
class FilterStudy:
    """A row and curves for each filter, the batch optimum last.

    `first_turn` is the mean square of the first step's heading error over its standard deviation. It
    scatters from study to study, and shifts the NEES of every estimator alike.
    """

    setting: Setting
    runs: int
    seed: int
    first_turn: float
    rows: tuple[FilterResult, ...]
    curves: Mapping[str, Curves]


def consistency_study(
    filters: Sequence[Mapping[str, Any] | str] = ("ekf", "fej", "oc", "riekf"),
    runs: int = 50,
    seed: int = 0,
    setting: Setting = HUANG,
    job: Job | None = None,
    stage: str = "filters",
) -> FilterStudy:
    """Run every filter over the same simulated runs and compare it with the truth.

    Parameters
    ----------
    filters : names of filters, or config tables with `kind` and parameters
    runs : number of simulated runs; run r's noise depends only on (seed, r)
    job : processes and progress; its number of seeds is ignored

    Raises
    ------
    ConfigError
        If a filter does not exist or its parameters are invalid.
    """
    tables = [{"kind": f} if isinstance(f, str) else dict(f) for f in filters]
    for table in tables:
        build("filter", table)
    results = (job or Job()).map(partial(_one_run, tables, setting, seed), range(runs), stage)
    squares = np.array([figures for figures, _ in results])  # (runs, estimators, figures, steps)
    first_turn = float(np.mean([turn**2 for _, turn in results]))
    curves, rows = {}, []
    for i, name in enumerate([*map(_label, tables), BATCH]):
        curves[name] = _curves(squares[:, i].mean(axis=0))
    for i, (name, curve) in enumerate(curves.items()):
        spread = _spread(squares[:, i, :3], np.random.default_rng([seed, runs]))
        rows.append(_result(name, curve, curves[BATCH], runs, spread))
    return FilterStudy(setting, runs, seed, first_turn, tuple(rows), curves)


def _curves(mean: Array) -> Curves:
    return Curves(mean[0], np.sqrt(mean[1]), np.sqrt(mean[2]), mean[3], mean[4], np.sqrt(mean[5]))


def _label(table: Mapping[str, Any]) -> str:
    """Return the filter's name with its given parameters."""
    given = ", ".join(f"{key}={value}" for key, value in table.items() if key != "kind")
    return f"{table['kind']} ({given})" if given else str(table["kind"])


def _result(name: str, curve: Curves, batch: Curves, runs: int, spread: Intervals) -> FilterResult:
    check, evaluated = np.isfinite(batch.nees), np.isfinite(curve.nees)

    def ratio(values: Array, best: Array) -> float:
        return _rms(values[check]) / _rms(best[check])

    return FilterResult(
        name,
        nees=float(curve.nees[evaluated].mean()),
        in_band=share_within(curve.nees[evaluated], runs, 3),
        nees_landmarks=float(curve.nees_landmarks[check].mean()),
        nis=float(curve.nis[check].mean()),
        position=_rms(curve.position[evaluated]),
        heading=_rms(curve.heading[evaluated]),
        position_ratio=ratio(curve.position, batch.position),
        heading_ratio=ratio(curve.heading, batch.heading),
        apart=_rms(curve.apart[check]),
        spread=spread,
    )


def _spread(squares: Array, rng: np.random.Generator) -> Intervals:
    """Return the intervals for squares (runs, 3, steps) of NEES, position and heading."""
    runs = len(squares)
    evaluated = np.isfinite(squares[0, 0])
    nees, position, heading = (resampled_means(squares[:, k, evaluated], rng) for k in range(3))
    return Intervals(
        _interval(nees.mean(axis=1)),
        _interval(np.array([share_within(means, runs, 3) for means in nees])),
        _interval(np.sqrt(position.mean(axis=1))),
        _interval(np.sqrt(heading.mean(axis=1))),
    )


def _interval(values: Array) -> Interval:
    low, high = np.quantile(values, [0.025, 0.975]).tolist()
    return low, high


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _one_run(tables: Sequence[Mapping[str, Any]], setting: Setting, seed: int, run: int) -> Run:
    """Return the values (filters + 1, 6, steps) averaged in `Curves`, batch last; and the first turn."""
    trial = simulate(setting, np.random.default_rng([seed, run]))
    checks = range(CHECK_EVERY, setting.steps, CHECK_EVERY)
    out = np.full((len(tables) + 1, 6, setting.steps), np.nan)
    best = np.full((setting.steps, 2), np.nan)
    for optimum in optima(setting, trial, checks):
        best[optimum.step] = optimum.pose[:2]
        _score_pose(out[-1], trial.truth, best, *optimum)
    for figures, table in zip(out, tables, strict=False):
        for k, (belief, which, nis) in enumerate(follow(setting, table, trial, checks), start=1):
            _score_pose(figures, trial.truth, best, k, belief.pose, belief.covariance)
            if k in checks:
                figures[3, k] = _landmark_nees(belief, setting.ring(), which)
                figures[4, k] = nis
    return out, trial.first_turn(setting)


def _landmark_nees(belief: Filter, true: Array, which: Mapping[int, int]) -> float:
    """Return the mean NEES of the landmarks."""
    found = belief.landmarks()
    errors = np.array([landmark.position - true[which[landmark.id]] for landmark in found])
    return float(nees(errors, np.array([landmark.covariance for landmark in found])).mean())


def _score_pose(
    figures: Array, truth: Array, best: Array, k: int, pose: Array, covariance: Array
) -> None:
    error = pose_errors(pose[None], truth[k, None])
    figures[0, k] = nees(error, covariance[None])[0]
    figures[1, k] = error[0, 0] ** 2 + error[0, 1] ** 2
    figures[2, k] = error[0, 2] ** 2
    figures[5, k] = np.sum((pose[:2] - best[k]) ** 2)


def follow(
    setting: Setting, table: Mapping[str, Any], trial: Trial, checks: Sequence[int] = ()
) -> Iterator[tuple[Filter, Mapping[int, int], float]]:
    """Run a filter, built from its config table, over the data with known association.

    Yields
    ------
    belief : the filter, after each step
    which : the true landmark's number by the filter's id
    nis : normalised innovation squared of the scan over its dimension at checks, else NaN
    """
    belief: Filter = build("filter", table)
    models = {"point": build("landmark", {"kind": "point"})}
    belief.start(trial.truth[0], START_SIGMA**2 * np.eye(3), models)
    Q, R = np.diag(setting.motion_sigmas**2), setting.sigma**2 * np.eye(2)
    ids: dict[int, int] = {}  # by the landmark's number
    for k, d_pose in enumerate(trial.odometry, start=1):
        visible = np.flatnonzero(trial.in_range[k - 1]).tolist()
        seen = {i: Observation("point", trial.measurements[k - 1, i], R) for i in visible}
        old, new = [i for i in seen if i in ids], [i for i in seen if i not in ids]
        observations = [seen[i] for i in old]
        matches = [Match(a, ids[i], R[0], R, 0.0) for a, i in enumerate(old)]
        belief.predict(Increment(k * setting.dt, d_pose, Q, setting.dt))
        nis = _nis(*belief.joint(observations, matches)) if k in checks and matches else np.nan
        belief.correct(observations, matches)
        entered = belief.extend([seen[i] for i in new], k * setting.dt)
        ids.update(zip(new, entered, strict=True))
        yield belief, {number: i for i, number in ids.items()}, nis


def _nis(innovation: Array, S: Array) -> float:
    return float(innovation @ np.linalg.solve(S, innovation)) / len(innovation)
