"""Every filter on the same data, in one table, for `imp reproduce filters`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import product
from typing import Any, cast

import numpy as np

from impslam.component import components
from impslam.config import load
from impslam.estimators.base import Estimator
from impslam.evaluation.consistency import nees, pose_errors
from impslam.evaluation.options import GATE
from impslam.map import Keyframe
from impslam.studies.batch_optimum import optima
from impslam.studies.circle_simulation import HUANG, LONG_LOOP, Setting, Trial, simulate
from impslam.studies.consistency_arena import SETTLED
from impslam.studies.filter_consistency import BATCH, CHECK_EVERY
from impslam.studies.filter_logs import log_rows
from impslam.studies.filter_scores import FilterScore, MeanInterval, score_filters
from impslam.studies.report import Picture, ResultTable, Section, load_text, make_table
from impslam.studies.sweep import StudyRun, Variant, sweep
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row, attempt, failures
from impslam.types import Array, Increment, Observation

TEXT = load_text("filter_table")
FILTERS: Mapping[str, Sequence[str]] = TEXT["filters"]
KNOWN = ("estimator.kind=landmarks", "association.kind=known", "lifecycle.kind=immediate")
"""Settings for simulated landmarks with known association."""
SETTINGS: Mapping[str, Setting] = {"circle": HUANG, "long loop": LONG_LOOP}
WORLDS = ("arena", "corridor")
MAX_DECIMAL_NEES = 1000.0
"""A larger NEES is printed in scientific notation."""
RUNS = 8
"""Default, for a quick look with wide intervals."""


def filter_table(job: Job) -> Section:
    """Run every filter on every data set; `job.seeds` is the number of runs."""
    runs, filters = range(job.seeds or RUNS), installed()
    rows: list[Row] = []
    for data in SETTINGS:
        work = list(product((*filters, BATCH), runs))
        rows += job.map(partial(_circle_row, data), work, data)
    variants = [Variant(name, "imp", tuple(given)) for name, given in filters.items()]
    rows += sweep(variants, runs, WORLDS, measure=world_row, job=job)
    rows += log_rows(filters, job)
    scores = {
        data: score_filters(rows, data) for data in dict.fromkeys(row["world"] for row in rows)
    }
    text = "\n\n".join(filter(None, (TEXT["text"], failures(rows))))
    tables = [_table(data, found) for data, found in scores.items()]
    return Section("filters", TEXT["title"], text, tables, _pictures(scores), scores, rows)


def installed() -> dict[str, Sequence[str]]:
    """Return the filters with installed libraries."""
    known = cast("dict[str, type[Estimator]]", components("estimator"))
    libraries = {name: made.library for name, made in known.items()}
    kinds = {
        name: load("imp", [*KNOWN, *given]).estimator["kind"] for name, given in FILTERS.items()
    }
    return {
        name: given
        for name, given in FILTERS.items()
        if not (library := libraries[kinds[name]]) or find_spec(library)
    }


def _circle_row(data: str, item: tuple[str, int]) -> Row:
    """Return the row of a filter, or of the optimum, on a simulated run."""
    name, run = item
    trial = simulate(SETTINGS[data], np.random.default_rng([0, run]))
    given = {"world": data, "variant": name, "seed": run}
    return attempt(given, lambda: circle_row(SETTINGS[data], name, trial))


def circle_row(setting: Setting, name: str, trial: Trial) -> Row:
    """Return the mean squares of a run's errors, over all steps and at the optimum's check points."""
    checks = range(CHECK_EVERY, setting.steps, CHECK_EVERY)
    begin = time.process_time()
    if name == BATCH:
        found = [(o.step, o.pose, o.covariance) for o in optima(setting, trial, checks)]
    else:
        found = list(
            _follow(setting, load("imp", [*KNOWN, *FILTERS[name]]).make_estimator(), trial)
        )
    seconds = time.process_time() - begin
    steps, poses, covariances = (np.array(column) for column in zip(*found, strict=True))
    errors = pose_errors(poses, trial.truth[steps])
    squares = (errors[:, :2] ** 2).sum(1)
    return {
        "nees": float(nees(errors, covariances).mean()),
        "position2": float(squares.mean()),
        "position2_at_checks": float(squares[np.isin(steps, checks)].mean()),
        "milliseconds": 1e3 * seconds / len(steps) if name != BATCH else math.nan,
    }


def _follow(
    setting: Setting, estimator: Estimator, trial: Trial
) -> Iterable[tuple[int, Array, Array]]:
    """Yield step, pose and covariance of an estimator on a simulated run."""
    Q, R = np.diag(setting.motion_sigmas**2), setting.sigma**2 * np.eye(2)
    none, no_scan = np.zeros((3, 3)), cast("Any", None)  # simulated landmarks have no scan
    for k, d_pose in enumerate(trial.odometry, start=1):
        seen = tuple(
            Observation("corner", trial.measurements[k - 1, i], R, label=i)
            for i in np.flatnonzero(trial.in_range[k - 1]).tolist()
        )
        motion = Increment(k * setting.dt, d_pose, Q, setting.dt)
        keyframe = Keyframe(
            k, motion.stamp, motion, none[0], none[0], none, no_scan, 0, observations=seen
        )
        revision = estimator.add(keyframe)
        yield k, revision.poses[-1], revision.covariances[-1]


def world_row(run: StudyRun) -> Row:
    """Return the same for a run in a world, with counts of missing and false landmarks."""
    from impslam.evaluation.landmarks import score_landmarks  # noqa: PLC0415

    later = run.rows.stamps - run.rows.stamps[0] >= SETTLED
    score = score_landmarks(run.landmarks, run.world.landmarks(), GATE)
    return {
        "nees": float(run.nees[later].mean()),
        "position2": float(np.mean(run.errors[later] ** 2)),
        "position2_at_checks": math.nan,
        "milliseconds": math.nan,
        "missing": len(score.missing),
        "false": len(score.false),
    }


def _table(data: str, scores: Mapping[str, FilterScore]) -> ResultTable:
    def number(value: float | MeanInterval, form: str) -> str:
        mean = value.value if isinstance(value, MeanInterval) else value
        return "" if math.isnan(mean) else f"{value:{form}}"

    columns: dict[str, Callable[[FilterScore], str]] = {
        "runs": lambda s: str(s.runs),
        "pose NEES": lambda s: number(s.nees, ".2f" if s.nees.value < MAX_DECIMAL_NEES else ".1e"),
        "position [m]": lambda s: number(s.position, ".3f" if s.position.value > 0.05 else ".4f"),
        "over the optimum": lambda s: number(s.over_optimum, ".3f"),
        "wrong matches [%]": lambda s: number(100.0 * s.wrong, ".1f"),
        "ms per step": lambda s: number(s.milliseconds, ".2f"),
        "memory [MB]": lambda s: number(s.megabytes, ".0f"),
    }
    used = {name: cell for name, cell in columns.items() if any(cell(s) for s in scores.values())}
    title = data[0].upper() + data[1:]
    return make_table(title, scores, used, TEXT["note"], ("filter",))


def _pictures(scores: Mapping[str, Mapping[str, FilterScore]]) -> list[Picture]:
    from impslam.evaluation.plots import as_png  # noqa: PLC0415  imports matplotlib
    from impslam.studies.filter_plot import draw_nees  # noqa: PLC0415

    cells = {data: {n: s.nees for n, s in found.items()} for data, found in scores.items()}
    # Without a true heading, as with GPS, there is no NEES.
    cells = {
        data: found
        for data, found in cells.items()
        if any(math.isfinite(cell.value) for cell in found.values())
    }
    return [Picture("filters-nees", as_png(draw_nees(cells), dpi=160), TEXT["caption"])]
