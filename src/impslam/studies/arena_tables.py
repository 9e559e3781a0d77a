"""Tables of the controlled experiments: those of the thesis (1 to 3), and further ones.

The column "Error (m)" of the thesis's tables is the squared distance between the two positions of its row,
to the last digit; here distances are computed from the positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from impslam.evaluation.landmarks import score_landmarks
from impslam.geometry.angles import wrap
from impslam.studies.arena_experiment import END, TEXT, Experiment, true_landmarks
from impslam.studies.report import ResultTable, make_table
from impslam.studies.sweep import StudyRun
from impslam.sweeps.statistics import (
    MEDIAN_95,
    Quantiles,
    Rows,
    mean_of,
    quantiles_of,
    runs_with,
)
from impslam.types import Array, TrueLandmark

END_POSITION = np.array([-0.4459, 2.3715])
NOTES = TEXT["notes"]
TRUE = {mark.name: mark for mark in true_landmarks()}
Groups = Mapping[str, Rows]


def tables(
    experiment: Experiment, runs: Groups, readings: Groups, shown: Mapping[str, StudyRun]
) -> list[ResultTable]:
    """Return the tables of an experiment: runs and other readings by variant, and the runs drawn."""
    walls = wall_table(experiment, runs)
    return [
        distance_table(experiment, runs),
        *([walls] if walls.rows else []),
        map_table(experiment, runs),
        position_table(experiment, shown),
        print_table(experiment),
        interpretation_table(experiment, readings),
    ]


def actual(name: str) -> Array:
    """Return the true position (2,) of a landmark or of the end of the drive, m, in map."""
    return END_POSITION if name == END else TRUE[name].position


def turned(printed: Sequence[float], actual: Array) -> float:
    """Return the rotation of the printed position about the start, rad, counter-clockwise."""
    return float(wrap(math.atan2(printed[1], printed[0]) - math.atan2(actual[1], actual[0])))


def too_far(printed: Sequence[float], actual: Array) -> float:
    """Return the excess distance of the printed position from the start, m."""
    return math.hypot(*printed) - math.hypot(*actual)


def off_middle(printed: Sequence[float], wall: TrueLandmark) -> float:
    """Return the distance of the printed wall from the middle of the true one, m."""
    assert wall.end_points is not None
    r = math.hypot(*printed)
    return float(abs(np.dot(printed, wall.end_points.mean(axis=0)) / r - r))


def _format(at: Sequence[float] | Array) -> str:
    return f"({at[0]:z.3f}, {at[1]:z.3f})"


def _errors(metric: str, runs: Groups) -> dict[str, Callable[[str], str]]:
    """Return a column for each variant: the quantiles of `metric NAME` by a landmark's name."""

    def column(rows: Rows) -> Callable[[str], str]:
        return lambda name: quantiles_of(f"{metric} {name}")(rows)

    return {f"{variant}, {MEDIAN_95}": column(rows) for variant, rows in runs.items()}


def distance_table(experiment: Experiment, runs: Groups) -> ResultTable:
    """Return the table of the thesis: distances computed as there, walls by their feet."""
    printed = experiment.printed
    columns: dict[str, Callable[[str], str]] = {
        "print": lambda name: f"{math.dist(printed[name], actual(name)):.3f}",
        **_errors("foot", runs),
    }
    labels = {(name, _format(actual(name))): name for name in (*experiment.names, END)}
    title = f"Distance from the truth in m, as thesis {experiment.text['table']} has it"
    return make_table(title, labels, columns, NOTES["distance"], ("", "actual x, y in m"))


def wall_table(experiment: Experiment, runs: Groups) -> ResultTable:
    """Return the perpendicular distances of walls at the middles of the true ones."""
    printed = experiment.printed
    columns: dict[str, Callable[[str], str]] = {
        "print": lambda name: f"{off_middle(printed[name], TRUE[name]):.3f}",
        **_errors("distance", runs),
    }
    walls = {name: name for name in experiment.names if TRUE[name].kind == "wall"}
    title = "Walls: perpendicular distance at the middle of the true wall, in m"
    return make_table(title, walls, columns, NOTES["walls"])


def _missing(names: Sequence[str]) -> Callable[[Rows], str]:
    return lambda rows: str(sum(bool(set(row["missing"]) & set(names)) for row in rows))


def _nees(rows: Rows) -> str:
    value = float(np.mean([row["nees"] for row in rows]))
    return f"{value:.2f}" if value < 100.0 else f"{value:.0e}"


def map_table(experiment: Experiment, runs: Groups) -> ResultTable:
    """Return missing and false landmarks, and the consistency of the estimate."""
    first = next(iter(runs.values()))
    columns: dict[str, Callable[[tuple[str, Rows]], str]] = {
        f"end in m, {MEDIAN_95}": lambda group: quantiles_of("end")(group[1]),
        "missing": lambda group: _missing(experiment.expected(group[0]))(group[1]),
        "false": lambda group: runs_with("false")(group[1]),
        "double": lambda group: runs_with("doubles")(group[1]),
        "pose NEES": lambda group: _nees(group[1]),
        "within 95 %": lambda group: mean_of("nees_within", ".0%")(group[1]).replace("%", " %"),
    }
    title = f"Consistency of the map, {len(first)} seeds"
    made = make_table(title, {name: (name, rows) for name, rows in runs.items()}, columns)
    wheels = ["wheels alone", quantiles_of("odometry_end")(first), "", "", "", "", ""]
    return ResultTable(title, made.header, [*made.rows, wheels], note=NOTES["map"])


def position_table(experiment: Experiment, shown: Mapping[str, StudyRun]) -> ResultTable:
    """Return actual and detected positions of the runs in the picture."""

    def detected(run: StudyRun) -> Callable[[str], str]:
        marks = {mark.id: mark.position for mark in run.landmarks}
        found = score_landmarks(run.landmarks, list(TRUE.values())).found
        positions = {error.name: marks[error.id] for error in found}
        positions[END] = run.path[-1, :2] - run.truth[-1, :2] + END_POSITION
        return lambda name: _format(positions[name]) if name in positions else "missing"

    columns: dict[str, Callable[[str], str]] = {
        "actual": lambda name: _format(actual(name)),
        "print": lambda name: _format(experiment.printed[name]),
        **{variant: detected(run) for variant, run in shown.items()},
    }
    seed = next(iter(shown.values())).seed
    names = {name: name for name in (*experiment.names, END)}
    return make_table(f"Positions x, y in m of seed {seed}", names, columns)


def print_table(experiment: Experiment) -> ResultTable:
    """Return rotation about the start and excess distance of the printed positions."""
    positions = {name: (at, actual(name)) for name, at in experiment.printed.items()}
    columns: dict[str, Callable[[tuple[Sequence[float], Array]], str]] = {
        "rotated about the start, deg": lambda both: f"{math.degrees(turned(*both)):+.1f}",
        "too far from the start, m": lambda both: f"{too_far(*both):+.3f}",
        "too far from the start, %": lambda both: (
            f"{100 * too_far(*both) / math.hypot(*both[1]):+.1f}"
        ),
    }
    return make_table(
        "What the printed positions have in common", positions, columns, NOTES["print"]
    )


def interpretation_table(experiment: Experiment, readings: Groups) -> ResultTable:
    """Return the errors of other readings of the thesis's text."""

    def worst(rows: Rows) -> str:
        names = experiment.names
        median = max(Quantiles.of(row[f"distance {name}"] for row in rows).median for name in names)
        return f"{median:.3f}" if math.isfinite(median) else "missing"

    return make_table(
        f"Other interpretations of the text, {len(next(iter(readings.values())))} seeds",
        readings,
        {
            f"end in m, {MEDIAN_95}": quantiles_of("end"),
            "worst in m": worst,
            "missing": _missing(experiment.names),
            "false": runs_with("false"),
            "pose NEES": _nees,
        },
        NOTES["interpretations"],
    )
