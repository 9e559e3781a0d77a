"""The thesis's uncontrolled environment (5.2.4): a long passage with doors, clutter and people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from impslam.studies.corridor_metrics import (
    DEFAULT,
    FROM_ROBOT,
    HOUGH,
    MAX_DRIFT,
    RANSAC,
    READINGS,
    TEXT,
    VARIANTS,
    corridor_metrics,
)
from impslam.studies.corridor_truth import corridor_truth, corridor_world, false_landmarks
from impslam.studies.corridor_walls import total_counts
from impslam.studies.report import Picture, ResultTable, Section, make_table
from impslam.studies.sweep import StudyRun, simulate_and_map, sweep
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row, by_variant, failures, median_row
from impslam.sweeps.statistics import MEDIAN_95, Quantiles, Rows, mean_of, number, quantiles_of

SEEDS = 6
"""Default, for a quick look in a few minutes; published results use 100."""
THESIS_SEEDS = 20
"""Maximum for the thesis's variants, which are lost in all seeds or in none; more run the default only."""
READING_SEEDS = 6
"""Seeds for each other interpretation of the text: enough to see which ones fail."""
NOTES = TEXT["notes"]
Groups = Mapping[str, Sequence[Row]]


def corridor(job: Job) -> Section:
    """Map the corridor with the default, and with the thesis's lines and each of its extractors."""
    world, seeds = [corridor_world()], range(job.seeds or SEEDS)
    rows = sweep(
        VARIANTS,
        seeds[:THESIS_SEEDS],
        world,
        corridor_metrics,
        job,
        "map the corridor, all variants",
    )
    default = [variant for variant in VARIANTS if variant.name == DEFAULT]
    rest = seeds[THESIS_SEEDS:]
    if rest:
        rows += sweep(default, rest, world, corridor_metrics, job, "map the corridor, the default")
    few = seeds[:READING_SEEDS]
    others = sweep(
        READINGS, few, world, corridor_metrics, job, "map the corridor, other interpretations"
    )
    runs, readings = by_variant(rows), by_variant(others)
    text = "\n\n".join(filter(None, (TEXT["text"], failures([*rows, *others]))))
    tables = [path_table(runs), map_table(runs), extractor_table(runs), reading_table(readings)]
    pictures = _pictures(int(median_row(runs[HOUGH])["seed"]))
    return Section(
        "corridor", TEXT["title"], text, tables, pictures, numbers(runs, readings), [*rows, *others]
    )


def _pictures(seed: int) -> list[Picture]:
    from impslam.studies.map_plot import CORRIDOR, draw_maps  # noqa: PLC0415  matplotlib, 0.3 s

    shown = simulate_and_map(corridor_world(), VARIANTS, seed)

    def draw(*names: str) -> bytes:
        runs = {_title(shown[name]): shown[name] for name in names}
        false = {title: false_landmarks(corridor_truth(), r.landmarks) for title, r in runs.items()}
        return draw_maps(runs, CORRIDOR, false)

    return [
        Picture("corridor", draw(DEFAULT, HOUGH, FROM_ROBOT), TEXT["picture"].format(seed=seed)),
        Picture("corridor-ransac", draw(RANSAC), TEXT["picture_ransac"].format(seed=seed)),
    ]


def _title(run: StudyRun) -> str:
    length, end = run.travelled[-1], run.errors[-1]
    share = 100.0 * end / length
    return f"{run.variant.name}: ends {end:.2f} m off, {share:.2f} % of {length:.0f} m"


def _percent(metric: str) -> Callable[[Rows], str]:
    """Return a function for a table cell: quantiles of a length over the distance travelled, %."""
    return lambda rows: str(Quantiles.of(100.0 * row[metric] / row["travelled"] for row in rows))


def _within(metric: str) -> Callable[[Rows], str]:
    """Return a cell: in how many runs a length is within `MAX_DRIFT` of the distance travelled."""
    return lambda rows: f"{_count_within(rows, metric)} of {len(rows)}"


def _count_within(rows: Rows, metric: str = "end") -> int:
    return sum(row[metric] <= MAX_DRIFT * row["travelled"] for row in rows)


PATH: dict[str, Callable[[Rows], str]] = {
    f"end error, % of distance, {MEDIAN_95}": _percent("end"),
    f"within {100.0 * MAX_DRIFT} %": _within("end"),
    f"path RMS in m, {MEDIAN_95}": quantiles_of("ate"),
    "holds for m, median": lambda rows: f"{np.median([row['holds'] for row in rows]):.0f}",
}
"""Columns on the errors of the path."""


def _seeds(rows: Rows) -> str:
    return f"{len(rows)} seed" if len(rows) == 1 else f"{len(rows)} seeds"


def path_table(runs: Groups) -> ResultTable:
    """Return the table of path errors of every variant."""
    first = next(iter(runs.values()))
    title = f"The path, {_seeds(first)} of {first[0]['travelled']:.0f} m"
    made = make_table(title, runs, PATH)
    cells = [cell(first) for cell in (_percent("odometry_end"), _within("odometry_end"))]
    wheels = ["wheels alone", *cells, quantiles_of("odometry_ate")(first), ""]
    return ResultTable(title, made.header, [*made.rows, wheels], note=NOTES["path"])


def map_table(runs: Groups) -> ResultTable:
    """Return the table of true and false landmarks in the map of every variant."""
    counts = total_counts(runs[DEFAULT])

    def spurious(rows: Rows) -> str:
        seen = counts[TEXT["variants"][rows[0]["variant"]]["extractor"]]
        return f"{seen['spurious'] / seen['scans']:.4f}"

    columns = {
        "spurious walls per scan": spurious,
        "landmarks ever": mean_of("landmarks_ever"),
        "people": mean_of("people_ever"),
        "false at first": mean_of("false_at_birth"),
        "false at the end": mean_of("false_at_the_end"),
        "missing": mean_of("missing"),
    }
    return make_table("The map, means over the seeds", runs, columns, NOTES["map"])


def extractor_table(runs: Groups) -> ResultTable:
    """Return the table of spurious walls per scan of each extractor, all on the same scans."""
    counts = total_counts(runs[DEFAULT])
    scans = next(iter(counts.values()))["scans"]
    columns: dict[str, Callable[[dict[str, int]], str]] = {
        "walls per scan": lambda seen: f"{seen['walls'] / scans:.2f}",
        "spurious per scan": lambda seen: f"{seen['spurious'] / scans:.4f}",
        "% of walls": lambda seen: f"{100.0 * seen['spurious'] / max(seen['walls'], 1):.2f}",
        "% of scans with one": lambda seen: f"{100.0 * seen['scans_with_spurious'] / scans:.1f}",
        "of them people": lambda seen: f"{seen['of_people']}",
    }
    title = f"Spurious walls of each extractor, the same {scans} scans among doors and people"
    return make_table(title, counts, columns, NOTES["extractors"])


def reading_table(readings: Groups) -> ResultTable:
    """Return the table of errors of other interpretations of the thesis."""
    many = _seeds(next(iter(readings.values())))
    columns = PATH | {"landmarks ever": mean_of("landmarks_ever", ".0f")}
    title = f"Other interpretations of the thesis's lines by Hough, {many}"
    return make_table(title, readings, columns, NOTES["readings"])


def numbers(runs: Groups, readings: Groups) -> dict[str, Any]:
    """Return the numbers behind the tables."""
    first = next(iter(runs.values()))
    return {
        "seeds": [row["seed"] for row in first],
        "way": first[0]["travelled"],
        "dead_reckoning_end": [row["odometry_end"] for row in first],
        **{name: _numbers(rows) for name, rows in runs.items()},
        "extractors": total_counts(runs[DEFAULT]),
        "readings": {name: _numbers(rows) for name, rows in readings.items()},
    }


def _numbers(rows: Rows) -> dict[str, Any]:
    """Return the numbers of one variant, each as a list over the seeds."""
    counts = ("landmarks_ever", "people_ever", "touched_by_people", "false_at_birth")
    return {
        "end": [row["end"] for row in rows],
        "seeds_within": _count_within(rows),
        "holds": [row["holds"] for row in rows],
        "path_rms": [row["ate"] for row in rows],
        **{name: [row[name] for row in rows] for name in counts},
        "false_at_the_end": [int(number(row["false_at_the_end"])) for row in rows],
        "missing": [list(row["missing"]) for row in rows],
    }
