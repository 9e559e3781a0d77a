"""Whether the filters' uncertainties are true and what they waste, for `imp reproduce consistency`.

Three Monte Carlo studies: the published setting in which filters are compared, a long loop, and the
whole system in the arena. The figures of `PUBLISHED` are what public code prints for the first one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from impslam.evaluation.consistency import chi2_bounds
from impslam.studies.base import Job, Part, Picture, Table
from impslam.studies.circle_simulation import HUANG, LONG_LOOP, Setting
from impslam.studies.consistency_arena import KINDS, Outcome, whole_system
from impslam.studies.filter_consistency import Row, Run, Study, consistency_study

FILTERS = ("ekf", "fej", "oc", "riekf")
RUNS = 100
"""The circle's, by default; the bootstrap then knows the EKF's mean NEES to about 0.5."""
RUNS_LOOP, RUNS_ARENA = 20, 20
"""At most, whatever is asked for: a run of them takes two and five times as long."""


@dataclass(frozen=True)
class Published:
    """What public code of the circle prints: mean pose NEES, share in the band, RMSE in m and deg."""

    name: str
    nees: float
    in_band: float
    position: float
    heading: float


PUBLISHED = (
    Published("EKF, published", 5.34, 0.04, 0.315, 3.82),
    Published("invariant EKF, published", 3.27, 0.86, 0.277, 3.39),
)

HEADER = (
    "estimator",
    "pose NEES",
    "95 % interval",
    "in band [%]",
    "landmark NEES",
    "NIS",
    "position [m]",
    "heading [deg]",
    "position / optimum",
    "heading / optimum",
)
IDEAL = ("ideal", "3", "", "95", "2", "1", "", "", "1", "1")
READING = (
    "Position and heading are RMSE, then over the batch optimum's; the interval is of the pose NEES, by "
    "the bootstrap over runs; “in band” is the share of steps whose mean NEES a consistent filter's would "
    "have with 95 % probability. "
)


def consistency(job: Job) -> Part:
    """Judge the filters by Monte Carlo; `job.seeds` is the number of runs on the circle."""
    runs = job.seeds or RUNS
    circle = study(job, HUANG, runs, "circle")
    loop = study(job, LONG_LOOP, min(runs, RUNS_LOOP), "long loop")
    arena = whole_system(job, min(runs, RUNS_ARENA))
    return Part(
        "consistency",
        "Consistency: are the uncertainties true?",
        TEXT,
        (circle_table(circle), loop_table(loop), arena_table(arena)),
        pictures(circle, loop, arena),
        {
            "circle": study_figures(circle),
            "circle_published": [asdict(row) for row in PUBLISHED],
            "long_loop": study_figures(loop),
            "arena": [arena_figures(outcome) for outcome in arena],
        },
    )


TEXT = """\
A filter is consistent if its errors are as large as it says. The normalised error squared (NEES) then \
has a chi-square distribution: its mean is 3 for a pose, 2 for a landmark, and that of the normalised \
innovation squared (NIS), over its dimension, 1. More is too sure, less is too modest. A filter is \
efficient if its errors are no larger than those of the batch optimum, the most likely path and map given \
all data up to the same step: a filter that only swells its covariance gains nothing there.

On the circle of Huang, Mourikis & Roumeliotis (2010) the first step, made before anything is seen, turns \
the whole map, and nothing that is seen later tells by how much. The textbook EKF (ekf) learns it all the \
same, from linearising at ever new places; with Jacobians at first estimates (fej), with Jacobians \
forced to see nothing there (oc), or with an error that moves with the map (riekf), nothing is learned \
that is not there.

That first turn is also why steps are not independent: its square is one of the three degrees of freedom \
of every step of a run. In a study whose draw of first turns is by chance large or small, all steps leave \
the band together. A perfect filter has 95 % of its steps in the band on average over studies, not in \
each: read the batch optimum's figures beside the filters'.

In the arena the whole system runs, from raw readings to the map, and noise is not what it is told. The \
preset allows for faults that a real room and a real robot have: walls that are not flat, ranges that \
share an error, wheels that slip. Further cases switch faults off in the simulation, and tell the preset."""


def study(job: Job, setting: Setting, runs: int, what: str) -> Study:
    """Run a setting's study in the job's processes."""

    def share(work: Callable[[int], Run], items: Iterable[int]) -> list[Run]:
        return job.map(work, items, what)

    return consistency_study(FILTERS, runs, setting=setting, share=share)


def circle_table(circle: Study) -> Table:
    """Return the published setting's table, print beside it."""
    printed = [_printed(row) for row in PUBLISHED]
    ekf, published = circle.rows[0], PUBLISHED[0]
    low, high = ekf.spread.nees
    scatter = (high - low) / 3.92
    return Table(
        f"Circle of Huang et al. 2010, {circle.runs} runs",
        HEADER,
        [IDEAL, *map(_cells, circle.rows), *printed],
        note=READING
        + f"The EKF's NEES is {ekf.nees:.2f} with a standard error of {scatter:.2f}, which for 50 runs "
        f"would be {scatter * math.sqrt(circle.runs / 50.0):.2f}; published is {published.nees:.2f}. "
        + _luck(circle),
    )


def loop_table(loop: Study) -> Table:
    """Return the long loop's table."""
    s = loop.setting
    way = 2.0 * math.pi * s.speed / s.turn_rate
    return Table(
        f"Long loop, {loop.runs} runs",
        HEADER,
        [IDEAL, *map(_cells, loop.rows)],
        note=f"The same robot on a circle of {way:.0f} m, twice round, {s.landmarks} landmarks of which "
        f"it sees those within {s.max_range:g} m. " + _luck(loop),
    )


def _luck(of: Study) -> str:
    """Tell what the draw of first turns does to all steps, and how wide the band is."""
    low, high = chi2_bounds(3, of.runs)
    scatter = math.sqrt(2.0 / of.runs)
    return (
        f"The mean square of the first turns is {of.first_turn:.2f} (1 ± {scatter:.2f}), which moves "
        f"the NEES of all estimators alike; the band is {low:.2f} to {high:.2f}."
    )


def _cells(row: Row) -> list[str]:
    """Return a table's row; the optimum has poses at check points only."""
    low, high = row.spread.nees
    return [
        row.name,
        f"{row.nees:.2f}",
        f"{low:.2f} to {high:.2f}",
        f"{100 * row.in_band:.0f}",
        _number(row.nees_landmarks, 2),
        _number(row.nis, 2),
        f"{row.position:.3f}",
        f"{math.degrees(row.heading):.2f}",
        f"{row.position_ratio:.3f}",
        f"{row.heading_ratio:.3f}",
    ]


def _printed(row: Published) -> list[str]:
    known = {1: f"{row.nees:.2f}", 3: f"{100 * row.in_band:.0f}"}
    known |= {6: f"{row.position:.3f}", 7: f"{row.heading:.2f}"}
    return [row.name, *(known.get(k, "") for k in range(1, len(HEADER)))]


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def arena_table(outcomes: Sequence[Outcome]) -> Table:
    """Return the whole system's table."""
    header = ["simulated", "filter", "runs", "pose NEES", "in band [%]"]
    header += [f"{kind} NIS" for kind in KINDS] + [f"{kind} NEES" for kind in KINDS]
    ideal = ["ideal", "", "", "3", "95", "1", "1", "1", "2", "2", "2"]
    rows = [
        [
            *(o.case, o.filter, str(o.runs), f"{o.mean:.2f}", f"{100 * o.in_band:.0f}"),
            *(_number(o.nis[kind], 2) for kind in KINDS),
            *(_number(o.landmarks[kind], 2) for kind in KINDS),
        ]
        for o in outcomes
    ]
    return Table(
        "The whole system in the arena, preset imp",
        header,
        [ideal, *rows],
        text=2,
        note="What is allowed for and not there makes NIS small: the walls' flatness, the lidar's bias. "
        "What is the same in every scan and taken for new each time, bias and mixed pixels, makes the map "
        "too sure: NEES of landmarks above 2. Pose NEES is small for the slip that is allowed for.",
    )


def pictures(circle: Study, loop: Study, arena: Sequence[Outcome]) -> tuple[Picture, ...]:
    """Return the curves of the three studies."""
    from impslam.evaluation.plots import as_png  # noqa: PLC0415
    from impslam.studies import consistency_plot as plot  # noqa: PLC0415  imports matplotlib

    cases = {o.case: o for o in arena}
    panels = [
        plot.NeesPanel(case, o.runs, o.times, {p.filter: p.nees for p in arena if p.case == case})
        for case, o in cases.items()
    ]
    return (
        Picture(
            "consistency-circle",
            as_png(plot.draw_study(circle), dpi=160),
            "Circle: NEES and errors by step.",
        ),
        Picture(
            "consistency-loop",
            as_png(plot.draw_study(loop), dpi=160),
            "Long loop: the textbook EKF is too sure from the first loop on.",
        ),
        Picture(
            "consistency-arena",
            as_png(plot.draw_nees(panels), dpi=160),
            "The whole system in the arena, preset imp.",
        ),
    )


def study_figures(of: Study) -> dict[str, Any]:
    """Return a study's numbers, in m and rad, ready for JSON."""
    rows = [{key: _plain(value) for key, value in asdict(row).items()} for row in of.rows]
    return {
        "runs": of.runs,
        "seed": of.seed,
        "first_turn": of.first_turn,
        "setting": asdict(of.setting),
        "rows": rows,
    }


def arena_figures(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome's numbers, ready for JSON."""
    return {
        "case": outcome.case,
        "filter": outcome.filter,
        "runs": outcome.runs,
        "nees": outcome.mean,
        "in_band": outcome.in_band,
        "nis": {kind: _plain(value) for kind, value in outcome.nis.items()},
        "landmark_nees": {kind: _plain(value) for kind, value in outcome.landmarks.items()},
    }


def _plain(value: Any) -> Any:
    """Return None for NaN, which JSON does not know."""
    return None if isinstance(value, float) and math.isnan(value) else value
