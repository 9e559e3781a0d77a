"""The thesis's controlled experiments (5.2.1 to 5.2.3): points, lines, and both, in the arena."""

from __future__ import annotations

from impslam.studies.arena_runs import DEFAULT, OFF, ArenaRun, Way, drifting, runs
from impslam.studies.arena_scores import NAMED, Errors, errors, representative
from impslam.studies.arena_setups import BOTH, LINES, POINTS, Setup
from impslam.studies.arena_tables import (
    distance_table,
    health_table,
    position_table,
    print_table,
    reading_table,
    wall_table,
)
from impslam.studies.base import Job, Part, Picture

SEEDS = 20
"""Enough for a first look; the claims are for 100."""
READINGS = 5
"""Seeds for each other reading of the text: enough to tell what fails."""
THESIS, LETTER, IMP = "thesis", "2 m gate", "default"
"""What the ways of mapping are called in tables and figures."""


def points(job: Job) -> Part:
    """Map the arena by its cylinders alone (thesis 5.2.1, Fig. 24, Table 1)."""
    return _experiment(job, POINTS)


def lines(job: Job) -> Part:
    """Map the arena by its walls alone (thesis 5.2.2, Fig. 25, Table 2)."""
    return _experiment(job, LINES)


def both(job: Job) -> Part:
    """Map the arena by walls and cylinders (thesis 5.2.3, Fig. 26, Table 3)."""
    return _experiment(job, BOTH)


def _experiment(job: Job, setup: Setup) -> Part:
    seeds = drifting(job, job.seeds or SEEDS)
    ways = _ways(setup)
    made = dict(zip(ways, runs(job, seeds, list(ways.values())), strict=True))
    came = {
        name: errors(many, NAMED if name == IMP else setup.names) for name, many in made.items()
    }
    readings = _readings(job, setup, seeds[:READINGS])
    seed = representative(made[THESIS]).seed
    one = {name: many[seeds.index(seed)] for name, many in made.items()}
    tables = [
        distance_table(setup, came),
        *([wall_table(setup, came)] if setup is not POINTS else []),
        health_table(came, made[THESIS]),
        position_table(setup, one),
        print_table(setup),
        reading_table(readings, min(READINGS, len(seeds))),
    ]
    figures = {
        "seeds": seeds,
        "skipped": _skipped(seeds),
        "shown_seed": seed,
        "dead_reckoning_end": [run.wheels for run in made[THESIS]],
        **{name.replace(" ", "_"): result.figures() for name, result in came.items()},
        "readings": {said: result.figures() for said, result in readings.items()},
    }
    text = f"{_what(setup, seeds)}\n\n{setup.why}"
    return Part(setup.name, setup.title, text, tables, [_picture(setup, one)], figures)


def _ways(setup: Setup) -> dict[str, Way]:
    letter = {} if setup.letter is None else {LETTER: setup.letter}
    return {THESIS: setup.thesis, **letter, IMP: DEFAULT}


def _readings(job: Job, setup: Setup, seeds: list[int]) -> dict[str, Errors]:
    made = runs(job, seeds, list(setup.readings.values()))
    return {
        said: errors(many, setup.names) for said, many in zip(setup.readings, made, strict=True)
    }


def _skipped(seeds: list[int]) -> int:
    """Return how many seeds before the last one are not among them."""
    return seeds[-1] + 1 - len(seeds)


def _what(setup: Setup, seeds: list[int]) -> str:
    """Say what was run."""
    return (
        f"The arena of thesis {setup.section}, simulated with the first {len(seeds)} of the seeds "
        f"0, 1, ... whose dead reckoning ends {OFF} m or more from the truth ({_skipped(seeds)} of "
        f"{seeds[-1] + 1} end nearer and are left out; the estimate has no say in it). Every seed is "
        "one drive of 18 m with its own noise; the ways of mapping are given the same readings: the "
        "thesis's extractors, association and filter, and the default preset."
    )


def _picture(setup: Setup, one: dict[str, ArenaRun]) -> Picture:
    from impslam.studies.arena_plot import arena_png  # noqa: PLC0415  matplotlib, 0.3 s

    seed = one[THESIS].seed
    titles = {THESIS: "thesis", LETTER: "thesis, gate of 2 m", IMP: "default"}
    caption = (
        f"Seed {seed}, the median one by the thesis preset's end error. Truth as an overhead camera "
        "sees it, odometry alone, the estimated path, and the landmarks with their 3σ ellipses, "
        "enlarged ten times to be seen; walls with their end points. Odometry that leaves the "
        f"arena is cut off. Beside thesis {setup.figure}."
    )
    png = arena_png({titles[name]: run for name, run in one.items()})
    return Picture(f"arena-{setup.name}", png, caption)
