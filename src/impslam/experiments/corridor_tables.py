"""The tables of the corridor: how far off the path ends, and what is in the map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from impslam.experiments.arena_scores import Spread
from impslam.experiments.base import Table
from impslam.experiments.corridor_runs import SEES, CorridorRun, Drive, Tally

WITHIN = 0.005
"""Of the distance travelled: the end is to be this near."""


def collect(drives: Sequence[Drive]) -> dict[str, list[CorridorRun]]:
    """Return the runs of every way, in the order of the drives."""
    return {name: [drive.runs[name] for drive in drives] for name in drives[0].runs}


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


def run_table(made: Mapping[str, Sequence[CorridorRun]], tallies: Mapping[str, Tally]) -> Table:
    """Return the path of every way, and what is in its map."""
    many = next(iter(made.values()))
    rows = [[name, *_row(runs, tallies[SEES[name]])] for name, runs in made.items()]
    wheels = Spread.of([100.0 * run.wheels / run.way for run in many])
    inside = sum(run.wheels <= WITHIN * run.way for run in many)
    rows.append(["wheels alone", _percent(wheels), f"{inside} of {len(many)}", *[""] * 7])
    return Table(
        f"The corridor, {len(many)} seeds of {many[0].way:.0f} m",
        [
            "",
            "end, % of way, median [95 %]",
            "within 0.5 %",
            "path RMS in m, median [95 %]",
            "spurious walls a scan",
            "landmarks ever",
            "of them people",
            "of them false",
            "false at the end",
            "missing",
        ],
        rows,
        note="The path's error is taken in the frame of the start, nothing aligned. Landmarks ever: "
        "all that ever entered a map, mean per seed, judged by what their beams hit when they did; "
        "people are counted over all seeds. False at the end: means per seed of landmarks with "
        "nothing of their kind within 0.25 m (and, of walls, 5 degrees) in the map's own frame, so "
        "that a map which is true to itself but turned is false. Missing: mean per seed, of the "
        "named walls, and cylinders where a way maps them.",
    )


def _row(runs: Sequence[CorridorRun], seen: Tally) -> list[str]:
    n = len(runs)
    inside = sum(run.end <= WITHIN * run.way for run in runs)
    ate = Spread.of([run.ate for run in runs])
    return [
        _percent(Spread.of([100.0 * run.end / run.way for run in runs])),
        f"{inside} of {n}",
        str(ate),
        f"{per_scan(seen.spurious, seen):.4f}",
        f"{sum(len(run.births) for run in runs) / n:.1f}",
        f"{sum(run.people for run in runs)}",
        f"{sum(run.false_births for run in runs) / n:.1f}",
        f"{sum(len(run.false) for run in runs) / n:.1f}",
        f"{sum(len(run.missing) for run in runs) / n:.1f}",
    ]


def _percent(spread: Spread) -> str:
    return f"{spread.median:.3f} [{spread.low:.3f}, {spread.high:.3f}]"


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
        **{name: _figures(runs) for name, runs in made.items()},
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


def _figures(runs: Sequence[CorridorRun]) -> dict[str, Any]:
    return {
        "end": [run.end for run in runs],
        "seeds_within": sum(run.end <= WITHIN * run.way for run in runs),
        "path_rms": [run.ate for run in runs],
        "landmarks_ever": [len(run.births) for run in runs],
        "people_ever": [run.people for run in runs],
        "touched_by_people": [run.touched for run in runs],
        "false_at_birth": [run.false_births for run in runs],
        "false_at_the_end": [len(run.false) for run in runs],
        "missing": [list(run.missing) for run in runs],
    }
