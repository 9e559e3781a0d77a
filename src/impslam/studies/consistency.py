"""Consistency and efficiency of the filters, for `imp reproduce consistency`.

Three Monte Carlo studies: the published setting in which filters are compared, a long loop, and the
whole system in the arena.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from impslam.evaluation.consistency import chi2_bounds
from impslam.studies.circle_simulation import HUANG, LONG_LOOP
from impslam.studies.consistency_arena import KINDS, ArenaConsistency, arena_consistency
from impslam.studies.filter_consistency import FilterResult, FilterStudy, consistency_study
from impslam.studies.report import (
    Picture,
    ResultTable,
    Section,
    load_text,
    make_table,
)
from impslam.sweeps.job import Job
from impslam.sweeps.rows import failures

FILTERS = ("ekf", "ukf", "fej", "oc", "riekf")
RUNS = 100
"""Default for the circle: the bootstrap interval of the EKF's mean NEES is then about 0.5."""
MAX_RUNS_LOOP, MAX_RUNS_ARENA = 20, 40
"""Upper bounds: these runs take two and five times as long."""
TEXT = load_text("consistency")
NOTES, PUBLISHED = TEXT["notes"], TEXT["published"]


def consistency(job: Job) -> Section:
    """Score the filters by Monte Carlo; `job.seeds` is the number of runs on the circle."""
    runs = job.seeds or RUNS
    circle = consistency_study(FILTERS, runs, setting=HUANG, job=job, stage="circle")
    few = min(runs, MAX_RUNS_LOOP)
    loop = consistency_study(FILTERS, few, setting=LONG_LOOP, job=job, stage="long loop")
    arena, rows = arena_consistency(job, min(runs, MAX_RUNS_ARENA))
    numbers = {
        "circle": study_numbers(circle),
        "circle_published": PUBLISHED,
        "long_loop": study_numbers(loop),
        "arena": [arena_numbers(result) for result in arena],
    }
    tables = circle_table(circle), loop_table(loop), arena_table(arena)
    text = "\n\n".join(filter(None, (TEXT["text"], failures(rows))))
    drawn = pictures(circle, loop, arena)
    return Section("consistency", TEXT["title"], text, tables, drawn, numbers, rows)


def _interval(row: FilterResult) -> str:
    low, high = row.spread.nees
    return f"{low:.2f} to {high:.2f}"


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}"


COLUMNS: dict[str, Callable[[FilterResult], str]] = {
    "pose NEES": lambda row: f"{row.nees:.2f}",
    "95 % interval": _interval,
    "in band [%]": lambda row: f"{100 * row.in_band:.0f}",
    "landmark NEES": lambda row: _number(row.nees_landmarks),
    "NIS": lambda row: _number(row.nis),
    "position [m]": lambda row: f"{row.position:.3f}",
    "heading [deg]": lambda row: f"{math.degrees(row.heading):.2f}",
    "position / optimum": lambda row: f"{row.position_ratio:.3f}",
    "heading / optimum": lambda row: f"{row.heading_ratio:.3f}",
}
IDEAL = ("ideal", "3", "", "95", "2", "1", "", "", "1", "1")


def _study_table(title: str, study: FilterStudy, note: str) -> ResultTable:
    """Return the table of filters; the optimum has poses at check points only."""
    made = make_table(title, {row.name: row for row in study.rows}, COLUMNS, labels=("estimator",))
    low, high = chi2_bounds(3, study.runs)
    scatter = math.sqrt(2.0 / study.runs)
    note += NOTES["first_turns"].format(mean=study.first_turn, scatter=scatter, low=low, high=high)
    return ResultTable(title, made.header, [IDEAL, *made.rows], note=note)


def circle_table(circle: FilterStudy) -> ResultTable:
    """Return the table of the published setting, with the published results."""
    ekf = circle.rows[0]
    low, high = ekf.spread.nees
    error = (high - low) / 3.92
    note = NOTES["circle"].format(
        nees=ekf.nees,
        error=error,
        error_50=error * math.sqrt(circle.runs / 50.0),
        published=PUBLISHED[0]["nees"],
    )
    made = _study_table(f"Circle of Huang et al. 2010, {circle.runs} runs", circle, note)
    printed = [
        [
            *(p["name"], f"{p['nees']:.2f}", "", f"{100 * p['in_band']:.0f}", "", ""),
            *(f"{p['position']:.3f}", f"{p['heading']:.2f}", "", ""),
        ]
        for p in PUBLISHED
    ]
    return ResultTable(made.title, made.header, [*made.rows, *printed], note=made.note)


def loop_table(loop: FilterStudy) -> ResultTable:
    """Return the table of the long loop."""
    s = loop.setting
    length = 2.0 * math.pi * s.speed / s.turn_rate
    note = NOTES["loop"].format(way=length, landmarks=s.landmarks, reach=s.max_range)
    return _study_table(f"Long loop, {loop.runs} runs", loop, note)


def _kind_columns() -> dict[str, Callable[[ArenaConsistency], str]]:
    def nis(kind: str) -> Callable[[ArenaConsistency], str]:
        return lambda result: _number(result.nis[kind])

    def nees(kind: str) -> Callable[[ArenaConsistency], str]:
        return lambda result: _number(result.landmarks[kind])

    return {f"{k} NIS": nis(k) for k in KINDS} | {f"{k} NEES": nees(k) for k in KINDS}


def arena_table(results: Sequence[ArenaConsistency]) -> ResultTable:
    """Return the table of the whole system."""
    columns: dict[str, Callable[[ArenaConsistency], str]] = {
        "runs": lambda result: str(result.runs),
        "pose NEES": lambda result: f"{result.mean:.2f}",
        "in band [%]": lambda result: f"{100 * result.in_band:.0f}",
        **_kind_columns(),
    }
    groups = {(result.case, result.filter): result for result in results}
    title, labels = "The whole system in the arena, preset imp", ("simulated", "filter")
    made = make_table(title, groups, columns, NOTES["arena"], labels)
    ideal = ["ideal", "", "", "3", "95", "1", "1", "1", "2", "2", "2"]
    return ResultTable(title, made.header, [ideal, *made.rows], made.text, made.note)


def pictures(
    circle: FilterStudy, loop: FilterStudy, arena: Sequence[ArenaConsistency]
) -> list[Picture]:
    """Return the curves of the three studies."""
    from impslam.evaluation.plots import as_png  # noqa: PLC0415  imports matplotlib
    from impslam.studies.consistency_plot import draw_arena, draw_study  # noqa: PLC0415

    drawn = draw_study(circle), draw_study(loop), draw_arena(arena)
    return [
        Picture(name, as_png(figure, dpi=160), caption)
        for (name, caption), figure in zip(TEXT["captions"].items(), drawn, strict=True)
    ]


def study_numbers(study: FilterStudy) -> dict[str, Any]:
    """Return a study's numbers, in m and rad."""
    return {
        "runs": study.runs,
        "seed": study.seed,
        "first_turn": study.first_turn,
        "setting": study.setting,
        "rows": study.rows,
    }


def arena_numbers(result: ArenaConsistency) -> dict[str, Any]:
    """Return the numbers of a case and a filter."""
    return {
        "case": result.case,
        "filter": result.filter,
        "runs": result.runs,
        "nees": result.mean,
        "in_band": result.in_band,
        "nis": result.nis,
        "landmark_nees": result.landmarks,
    }
