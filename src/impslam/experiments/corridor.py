"""The thesis's uncontrolled environment (5.2.4): a long passage with doors, clutter and people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from impslam.experiments.base import Job, Part, Picture
from impslam.experiments.corridor_runs import (
    DEFAULT,
    HOUGH,
    RANSAC,
    CorridorRun,
    Drive,
    drive_corridor,
)
from impslam.experiments.corridor_tables import (
    collect,
    extractor_table,
    extractor_tallies,
    figures,
    run_table,
)

SEEDS = 6
"""Enough for a first look, a minute or two; the claims are for 100."""

WORLD = (
    "A passage of 47 m with a second one round the corner, 19 doors, some open, some that open while "
    "the robot is near, pillars and boxes along the walls, and six people who walk past it, overtake "
    "it and come out of doors. The robot of the arena drives to the far end and back, 117 m at up to "
    "0.6 m/s, with a lidar that sees 5.6 m: most of the time neither end. Parameters are those of the "
    "arena, of the robot, its noise, and every way of mapping."
)
WHY = (
    "What tells how far the robot has come. Two parallel walls tell where it is across and how it "
    "heads, and nothing along: there an estimate by walls alone is as good as the wheels between "
    "one crossing wall and the next. The default also maps the corners that rooms and recesses show, "
    "and cylinders, and so has points along the whole passage."
)


def corridor(job: Job) -> Part:
    """Map the corridor by the default, and by the thesis's lines with each of its extractors."""
    seeds = range(job.seeds or SEEDS)
    return report(job.map(drive_corridor, seeds, "drive and map the corridor"))


def report(drives: Sequence[Drive]) -> Part:
    """Return the section on some drives."""
    tallies = extractor_tallies(drives)
    tables = [run_table(collect(drives), tallies), extractor_table(tallies)]
    text = "\n\n".join((WORLD, WHY))
    title = "The uncontrolled corridor (thesis 5.2.4)"
    return Part("corridor", title, text, tables, _pictures(drives), figures(drives))


def shown(drives: Sequence[Drive]) -> Drive:
    """Return the drive that is the median one by the end of the thesis's Hough way."""
    ranked = sorted(drives, key=lambda drive: drive.runs[HOUGH].end)
    return ranked[(len(ranked) - 1) // 2]


def _pictures(drives: Sequence[Drive]) -> list[Picture]:
    from impslam.experiments.corridor_plot import corridor_png  # noqa: PLC0415  matplotlib, 0.3 s

    drive = shown(drives)
    which = f"Seed {drive.seed}, the median one by the Hough way's end error."
    good: Mapping[str, CorridorRun] = {name: drive.runs[name] for name in (DEFAULT, HOUGH)}
    return [
        Picture(
            "corridor",
            corridor_png(good),
            f"{which} Truth, odometry alone (cut off where it leaves the picture), the estimated path "
            "and the map; doors as they are at the beginning. Landmarks with nothing of their kind "
            "within 0.25 m are black. Beside thesis Fig. 29.",
        ),
        Picture(
            "corridor-ransac",
            corridor_png({RANSAC: drive.runs[RANSAC]}),
            f"Seed {drive.seed} again: the thesis's lines by RANSAC.",
        ),
    ]
