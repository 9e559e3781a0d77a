"""The tables of the controlled experiments: like the thesis's Tables 1 to 3, and beyond."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from impslam.studies.arena_print import DETECTED, END, off_middle, too_far, turned
from impslam.studies.arena_runs import ArenaRun, true_landmarks
from impslam.studies.arena_scores import Errors, Spread
from impslam.studies.arena_setups import Setup
from impslam.studies.base import Table
from impslam.types import Array

TRUTH = {mark.name: mark for mark in true_landmarks()}
END_POSITION = np.array([-0.4459, 2.3715])
SPREAD = "median [95 %]"


def _actual(name: str) -> Array:
    return END_POSITION if name == END else TRUTH[name].position


def _place(at: Sequence[float] | Array) -> str:
    return f"({at[0]:z.3f}, {at[1]:z.3f})"


def _nees(value: float) -> str:
    return f"{value:.2f}" if value < 100.0 else f"{value:.0e}"


def distance_table(setup: Setup, came: Mapping[str, Errors]) -> Table:
    """Return the table of the thesis: distances as it scores them, walls by their feet."""
    printed = DETECTED[setup.name]
    rows = [
        [
            name,
            _place(_actual(name)),
            f"{math.dist(printed[name], _actual(name)):.3f}",
            *(str(result.foot[name]) for result in came.values()),
        ]
        for name in (*setup.names, END)
    ]
    header = ["", "actual x, y in m", "print", *(f"{name}, {SPREAD}" for name in came)]
    return Table(
        f"Distance from the truth in m, as thesis {setup.table} has it",
        header,
        rows,
        text=2,
        note="The print is computed from its positions (its own column holds squares). Walls are "
        "scored by the distance between the feet of their normals from the start, as in the thesis: "
        "a turned wall is off by more, the further its foot is from what is seen of it.",
    )


def wall_table(setup: Setup, came: Mapping[str, Errors]) -> Table:
    """Return how far walls are from the true ones where these are: across, at their middles."""
    walls = [name for name in setup.names if TRUTH[name].kind == "wall"]
    rows = [
        [
            name,
            f"{off_middle(DETECTED[setup.name][name], TRUTH[name]):.3f}",
            *(str(result.distance[name]) for result in came.values()),
        ]
        for name in walls
    ]
    return Table(
        "Walls: perpendicular distance at the middle of the true wall, in m",
        ["", "print", *(f"{name}, {SPREAD}" for name in came)],
        rows,
        note="Where the wall is, not where its line passes the start.",
    )


def health_table(came: Mapping[str, Errors], made: Sequence[ArenaRun]) -> Table:
    """Return what is missing and false, and whether the estimate knows how good it is."""
    rows = [
        [
            name,
            str(result.foot[END]),
            f"{len(result.missing)}",
            f"{len(result.false)}",
            f"{len(result.double)}",
            _nees(result.nees),
            f"{100 * result.within:.0f} %",
        ]
        for name, result in came.items()
    ]
    wheels = Spread.of([run.wheels for run in made])
    rows.append(["wheels alone", str(wheels), "", "", "", "", ""])
    header = ["", f"end in m, {SPREAD}", "missing", "false", "double", "pose NEES", "within 95 %"]
    return Table(
        f"The map and its honesty, {len(made)} seeds",
        header,
        rows,
        note="Seeds whose map misses a landmark, has one where there is nothing, or has one twice "
        "(the default's corners count as false or double where they are). NEES is the mean over "
        "seeds and scans, 3 for an estimate that knows how wrong it is, less if it is too modest; "
        "the last column is the share of scans within the bound that 95 % are to keep. The default "
        "is modest here, since it allows for what real robots and rooms have and this simulation "
        "has less of: walls 5 mm from flat, 5 mm of bias of the ranges, wheels that slip sideways.",
    )


def position_table(setup: Setup, one: Mapping[str, ArenaRun]) -> Table:
    """Return actual and detected positions of the run that the picture shows."""
    detected = {name: _detected(run) for name, run in one.items()}
    seed = next(iter(one.values())).seed
    rows = [
        [
            name,
            _place(_actual(name)),
            _place(DETECTED[setup.name][name]),
            *(_place(at[name]) if name in at else "missing" for at in detected.values()),
        ]
        for name in (*setup.names, END)
    ]
    header = ["", "actual", "print", *one]
    return Table(f"Positions x, y in m of seed {seed}", header, rows, text=1)


def _detected(run: ArenaRun) -> dict[str, Array]:
    marks = {mark.id: mark for mark in run.landmarks}
    found = {error.name: marks[error.id].position for error in run.score().found}
    return {**found, END: run.path[-1, :2] - run.truth[-1, :2] + END_POSITION}


def print_table(setup: Setup) -> Table:
    """Return how the printed positions are turned about the start and too far from it."""
    rows = [
        [
            name,
            f"{math.degrees(turned(at, _actual(name))):+.1f}",
            f"{too_far(at, _actual(name)):+.3f}",
            f"{100 * too_far(at, _actual(name)) / math.hypot(*_actual(name)):+.1f}",
        ]
        for name, at in DETECTED[setup.name].items()
    ]
    return Table(
        "What the printed positions have in common",
        ["", "turned about the start, deg", "too far from it, m", "of its distance, %"],
        rows,
        note="Centres and feet, seen from the start.",
    )


def reading_table(readings: Mapping[str, Errors], number: int) -> Table:
    """Return what becomes of other readings of the text."""
    rows = [
        [
            said,
            str(result.foot[END]),
            _worst(result),
            f"{len(result.missing)}",
            f"{len(result.false)}",
            _nees(result.nees),
        ]
        for said, result in readings.items()
    ]
    return Table(
        f"Other readings of the text, {number} seeds",
        ["", f"end in m, {SPREAD}", "worst in m", "missing", "false", "pose NEES"],
        rows,
        note="The worst landmark is the one whose median distance is largest; missing and false count "
        "seeds, as above.",
    )


def _worst(result: Errors) -> str:
    worst = max(spread.median for name, spread in result.distance.items() if name != END)
    return f"{worst:.3f}" if math.isfinite(worst) else "missing"
