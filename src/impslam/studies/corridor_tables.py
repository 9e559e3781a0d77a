"""The tables of the corridor: how far off the path ends, and what is in the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from impslam.studies.arena_scores import Spread
from impslam.studies.base import Table
from impslam.studies.corridor_runs import SEES, CorridorRun, Drive, Tally, rms

WITHIN = 0.005
"""Of the distance travelled: the end is to be this near."""


def collect(drives: Sequence[Drive]) -> dict[str, list[CorridorRun]]:
    """Return the runs of every way, in the order of the drives; the first drive was mapped by all."""
    return {
        name: [drive.runs[name] for drive in drives if name in drive.runs]
        for name in drives[0].runs
    }


def total(tallies: Sequence[Tally]) -> Tally:
    """Return them all together."""
    return sum(tallies, Tally())


def extractor_tallies(drives: Sequence[Drive]) -> dict[str, Tally]:
    """Return what each extractor saw in all drives."""
    return {
        name: total([drive.extractors[name] for drive in drives]) for name in drives[0].extractors
    }


def per_scan(part: int, tally: Tally) -> float:
    """Return how many a scan."""
    return part / max(tally.scans, 1)


def path_table(made: Mapping[str, Sequence[CorridorRun]]) -> Table:
    """Return how far off the path of every way is."""
    many = next(iter(made.values()))
    rows = [[name, *_path_row(runs)] for name, runs in made.items()]
    wheels = Spread.of([100.0 * run.wheels / run.way for run in many])
    inside = sum(run.wheels <= WITHIN * run.way for run in many)
    dead = Spread.of([rms(run.odometry, run.truth) for run in many])
    rows.append(["wheels alone", _percent(wheels), f"{inside} of {len(many)}", str(dead), ""])
    header = [
        "",
        "end, % of way, median [95 %]",
        f"within {100.0 * WITHIN} %",
        "path RMS in m, median [95 %]",
        "holds for m, median",
    ]
    return Table(
        f"The path, {_seeds(len(many))} of {many[0].way:.0f} m",
        header,
        rows,
        note="Errors are taken in the frame of the start, nothing aligned. A path holds as far as the "
        f"robot drove before it was {100.0 * WITHIN} % of the whole way off for the first time.",
    )


def _path_row(runs: Sequence[CorridorRun]) -> list[str]:
    inside = sum(run.end <= WITHIN * run.way for run in runs)
    return [
        _percent(Spread.of([100.0 * run.end / run.way for run in runs])),
        f"{inside} of {len(runs)}",
        str(Spread.of([run.ate for run in runs])),
        f"{np.median([run.holds(WITHIN * run.way) for run in runs]):.0f}",
    ]


def map_table(made: Mapping[str, Sequence[CorridorRun]], seen: Mapping[str, Tally]) -> Table:
    """Return what is in the map of every way, and how much of it is not there."""
    rows = [[name, *_map_row(runs, seen[SEES[name]])] for name, runs in made.items()]
    header = [
        "",
        "spurious walls a scan",
        "landmarks ever",
        "people",
        "false at first",
        "false at the end",
        "missing",
    ]
    return Table(
        "The map, means over the seeds",
        header,
        rows,
        note="Landmarks ever: all that ever were in the map. When one entered, what its beams had hit "
        "was looked up: it is a person if half of them or more hit people, or if it lies within 0.4 m "
        "of one and not within 0.1 m of anything that stands; it is false if nothing of its kind is "
        "there. False at the end: nothing of its kind within 0.25 m of it (and 5 degrees, of walls) "
        "in the map's own frame, so that a map which is turned is false though all in it was seen. "
        "Missing: of the world's walls, and of its pillars where a way maps cylinders.",
    )


def _map_row(runs: Sequence[CorridorRun], seen: Tally) -> list[str]:
    counts = (
        [len(run.births) for run in runs],
        [run.people for run in runs],
        [run.false_births for run in runs],
        [len(run.false) for run in runs],
        [len(run.missing) for run in runs],
    )
    return [f"{per_scan(seen.spurious, seen):.4f}", *(f"{np.mean(many):.2f}" for many in counts)]


def _percent(spread: Spread) -> str:
    return f"{spread.median:.3f} [{spread.low:.3f}, {spread.high:.3f}]"


def reading_table(many: Sequence[Mapping[str, CorridorRun]]) -> Table:
    """Return what becomes of other readings of the thesis."""
    rows = []
    for name in many[0]:
        runs = [readings[name] for readings in many]
        path = _path_row(runs)
        rows.append([name, *path, f"{np.mean([len(run.births) for run in runs]):.0f}"])
    header = [
        "",
        "end, % of way, median [95 %]",
        f"within {100.0 * WITHIN} %",
        "path RMS in m, median [95 %]",
        "holds for m, median",
        "landmarks ever",
    ]
    return Table(
        f"Other readings of the thesis's lines by Hough, {_seeds(len(many))}",
        header,
        rows,
        note="As 'thesis, Hough' (a gate of 1.41 m between feet, a threshold of 40 px, bins of 10 "
        "degrees), but for what is named.",
    )


def _seeds(number: int) -> str:
    return f"{number} seed" if number == 1 else f"{number} seeds"


def extractor_table(tallies: Mapping[str, Tally]) -> Table:
    """Return spurious walls per scan of each extractor, all on the same scans."""
    rows = [
        [
            name,
            f"{per_scan(tally.walls, tally):.2f}",
            f"{per_scan(tally.spurious, tally):.4f}",
            f"{100.0 * tally.spurious / max(tally.walls, 1):.2f}",
            f"{100.0 * per_scan(tally.marred, tally):.1f}",
            f"{tally.people}",
        ]
        for name, tally in tallies.items()
    ]
    scans = next(iter(tallies.values())).scans
    return Table(
        f"Spurious walls of each extractor, the same {scans} scans among doors and people",
        [
            "",
            "walls a scan",
            "spurious a scan",
            "% of walls",
            "% of scans with one",
            "of them people",
        ],
        rows,
        note="A wall is spurious unless half of its beams or more hit one plane (a wall with its shut "
        "doors is one, an open leaf, a box's side, a room's wall) and it lies in that plane: within "
        "10 degrees, a bin of the thesis's transform, and within 0.2 m at the middle of what was "
        "seen. Every tenth scan, de-skewed with the true motion.",
    )


def figures(drives: Sequence[Drive]) -> dict[str, Any]:
    """Return the numbers behind the tables."""
    made = collect(drives)
    first = next(iter(made.values()))
    return {
        "seeds": [drive.seed for drive in drives],
        "way": first[0].way,
        "dead_reckoning_end": [run.wheels for run in first],
        **{name: run_figures(runs) for name, runs in made.items()},
        "extractors": {
            name: {
                "scans": tally.scans,
                "walls": tally.walls,
                "spurious": tally.spurious,
                "of_people": tally.people,
                "scans_with_spurious": tally.marred,
            }
            for name, tally in extractor_tallies(drives).items()
        },
    }


def run_figures(runs: Sequence[CorridorRun]) -> dict[str, Any]:
    """Return the numbers behind one way's rows."""
    return {
        "end": [run.end for run in runs],
        "seeds_within": sum(run.end <= WITHIN * run.way for run in runs),
        "holds": [run.holds(WITHIN * run.way) for run in runs],
        "path_rms": [run.ate for run in runs],
        "landmarks_ever": [len(run.births) for run in runs],
        "people_ever": [run.people for run in runs],
        "touched_by_people": [run.touched for run in runs],
        "false_at_birth": [run.false_births for run in runs],
        "false_at_the_end": [len(run.false) for run in runs],
        "missing": [list(run.missing) for run in runs],
    }
