"""The thesis's controlled experiments (5.2.1 to 5.2.3): points, lines, and both, in the arena."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from impslam.simulation.world import load_world
from impslam.studies.arena_experiment import (
    PRINTED_GATE,
    TEXT,
    THESIS,
    Experiment,
    landmark_metrics,
    summary,
)
from impslam.studies.arena_seeds import MIN_DRIFT, drifting_seeds
from impslam.studies.arena_tables import tables
from impslam.studies.report import Picture, Section
from impslam.studies.sweep import StudyRun, simulate_and_map, sweep
from impslam.sweeps.job import Job
from impslam.sweeps.rows import by_variant, failures, median_row

SEEDS = 20
"""Default, for a quick look; published results use 100."""
INTERPRETATION_SEEDS = 5
"""Seeds for each other interpretation of the thesis's text: enough to see which ones fail."""


def points(job: Job) -> Section:
    """Map the arena by its cylinders alone (thesis 5.2.1, Fig. 24, Table 1)."""
    return _run(job, Experiment.load("points"))


def lines(job: Job) -> Section:
    """Map the arena by its walls alone (thesis 5.2.2, Fig. 25, Table 2)."""
    return _run(job, Experiment.load("lines"))


def both(job: Job) -> Section:
    """Map the arena by walls and cylinders (thesis 5.2.3, Fig. 26, Table 3)."""
    return _run(job, Experiment.load("both"))


def _run(job: Job, experiment: Experiment) -> Section:
    seeds = drifting_seeds(job, job.seeds or SEEDS)
    rows = sweep(experiment.variants, seeds, measure=landmark_metrics, job=job)
    some = seeds[:INTERPRETATION_SEEDS]
    others = sweep(experiment.interpretations, some, measure=landmark_metrics, job=job)
    runs, readings = by_variant(rows), by_variant(others)
    seed = median_row(runs[THESIS])["seed"]
    shown = simulate_and_map(load_world("arena"), experiment.variants, seed)
    numbers = {
        "seeds": seeds,
        "skipped": seeds[-1] + 1 - len(seeds),
        "shown_seed": seed,
        "dead_reckoning_end": [row["odometry_end"] for row in runs[THESIS]],
        **{
            name.replace(" ", "_"): summary(r, experiment.expected(name))
            for name, r in runs.items()
        },
        "readings": {name: summary(r, experiment.names) for name, r in readings.items()},
    }
    text = "\n\n".join(filter(None, (_text(experiment, seeds), failures([*rows, *others]))))
    pictures = [_picture(experiment, shown)]
    title, made = experiment.text["title"], tables(experiment, runs, readings, shown)
    return Section(experiment.name, title, text, made, pictures, numbers, [*rows, *others])


def _text(experiment: Experiment, seeds: Sequence[int]) -> str:
    """Return a description of the runs, and of the differences from the thesis."""
    about = TEXT["about"].format(
        section=experiment.text["section"],
        count=len(seeds),
        off=MIN_DRIFT,
        skipped=seeds[-1] + 1 - len(seeds),
        tried=seeds[-1] + 1,
    )
    return f"{about}\n\n{experiment.text['text'].format(**TEXT['paragraphs'])}"


def _picture(experiment: Experiment, shown: Mapping[str, StudyRun]) -> Picture:
    from impslam.studies.map_plot import ARENA, draw_maps  # noqa: PLC0415  matplotlib, 0.3 s

    titles = {
        f"{name.replace(PRINTED_GATE, 'thesis, gate of 2 m')}\nend {run.errors[-1]:.3f} m off": run
        for name, run in shown.items()
    }
    seed = next(iter(shown.values())).seed
    caption = TEXT["picture"].format(seed=seed, figure=experiment.text["figure"])
    return Picture(f"arena-{experiment.name}", draw_maps(titles, ARENA), caption)
