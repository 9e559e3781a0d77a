"""The thesis's uncontrolled environment (5.2.4): a long passage with doors, clutter and people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

from impslam.studies.base import Job, Part, Picture
from impslam.studies.corridor_runs import (
    DEFAULT,
    HOUGH,
    LIKELY,
    RANSAC,
    CorridorRun,
    Drive,
    drive_corridor,
    read_otherwise,
)
from impslam.studies.corridor_tables import (
    collect,
    extractor_table,
    extractor_tallies,
    figures,
    map_table,
    path_table,
    reading_table,
    run_figures,
)

SEEDS = 6
"""Enough for a first look, in a few minutes; the claims are for 100."""
EVERY_WAY = 20
"""Seeds for the thesis's ways: they are lost in every one, or in none. The others are the default's."""
READ = 2
"""Seeds for each other reading of the text: it fails, or it does not."""

WORLD = (
    "A passage of 47 m and a second one round the corner, 2 m wide, with 19 doors, some open, some "
    "that open and shut while the robot is near, rooms behind them, pillars and boxes along the walls, "
    "and six people who walk towards the robot, overtake it, cross its way and go through the doors. "
    "The robot of the arena drives to the far end and back, 117 m at up to 0.6 m/s. Its lidar sees "
    "5.6 m: most of the time neither end of the passage. Nothing is changed from the arena: not the "
    "robot's faults, and no parameter of any way of mapping. The wheels' faults (0.1 % of a radius, "
    "2 % of the track, 1 cm in 1 m of uneven ground, a few per cent of the rotation lost in turns) add "
    "up to metres here, most of it by the heading: half a degree is 0.4 m after 45 m."
)
HELD = (
    "The default keeps its place all the way. It has points along the passage, corners of rooms, of "
    "doorways and of the passage's ends, and pillars, and takes a wall for one that it knows only if "
    "that is likely given how uncertain both are. People do not become landmarks: a leg is too narrow "
    "for a wall, and what moves on within 0.4 s never gets beyond a trial."
)
LOST = (
    "The thesis's way, Hough's walls matched by feet and angle, is lost here some 30 m from the start, "
    "and not for want of good walls: next to nothing that it sees is spurious, and people are "
    "not taken for walls, as the thesis says (one who walks close along a wall may be seen as part of "
    "it). It is the matching. Walls are compared by the feet of "
    "their normals from the start, and an angle that is off by one degree moves the foot of a wall "
    "40 m away by 0.7 m; the bins are 10 degrees wide. The two sides of the passage have their feet "
    "2 m apart, and the angle does not tell them apart ('close to 0 or 180 degrees'), so that at "
    "last one is taken for the other, or a box for the back of a room. The innovation "
    "is then half a turn. There are no tentative landmarks, and nothing recovers from it. Other gates, "
    "thresholds and bins only change where it happens. In the arena "
    "no foot is more than 6.1 m from the start; in thesis Fig. 29 the way holds, so its passage must have "
    "been kinder, or its association other than printed."
)
FOUND = (
    "'Hough by likelihood' is the same but for one thing: Hough's walls, every one of them a landmark "
    "at once, in every scan, but matched by likelihood as the default does. It comes back to within "
    "0.1 % of the way. So the thesis is right about Hough's walls. Those along a passage do not tell how "
    "far the robot has come, but here others stand across it every few metres, in the rooms behind "
    "open doors, and the path is never more than 0.25 m off along it. It is further off across "
    "(half a metre at the far end): the bins of 10 degrees turn the passage by half a degree."
)
FAILS = (
    "RANSAC fails as the thesis saw it. One of its walls in twenty, in one scan of seven, is a "
    "line askew through both sides of the passage or through a door. Each of them is a landmark at "
    "once and pulls the pose when the next is taken for it: within metres the map is a bundle of lines."
)


def corridor(job: Job) -> Part:
    """Map the corridor by the default, and by the thesis's lines with each of its extractors."""
    seeds = range(job.seeds or SEEDS)
    drives = job.map(drive_corridor, seeds[:EVERY_WAY], "map the corridor, every way")
    alone = partial(drive_corridor, ways=(DEFAULT,))
    drives += job.map(alone, seeds[EVERY_WAY:], "map the corridor, the default")
    return report(drives, job.map(read_otherwise, seeds[:READ], "read the thesis otherwise"))


def report(drives: Sequence[Drive], readings: Sequence[Mapping[str, CorridorRun]]) -> Part:
    """Return the section on some drives, and on other readings of the thesis in some of them."""
    made, tallies = collect(drives), extractor_tallies(drives)
    tables = [
        path_table(made),
        map_table(made, tallies),
        extractor_table(tallies),
        reading_table(readings),
    ]
    text = "\n\n".join((WORLD, HELD, LOST, FOUND, FAILS))
    title = "The uncontrolled corridor (thesis 5.2.4)"
    numbers = figures(drives)
    numbers["readings"] = {
        name: run_figures([runs[name] for runs in readings]) for name in readings[0]
    }
    return Part("corridor", title, text, tables, _pictures(drives), numbers)


def shown(drives: Sequence[Drive]) -> Drive:
    """Return the drive that is the median one by the end of the thesis's Hough way."""
    ranked = sorted((d for d in drives if HOUGH in d.runs), key=lambda drive: drive.runs[HOUGH].end)
    return ranked[(len(ranked) - 1) // 2]


def _pictures(drives: Sequence[Drive]) -> list[Picture]:
    from impslam.studies.corridor_plot import corridor_png  # noqa: PLC0415  matplotlib, 0.3 s

    drive = shown(drives)
    which = f"Seed {drive.seed}, the median one by the Hough way's end error."
    good: Mapping[str, CorridorRun] = {name: drive.runs[name] for name in (DEFAULT, HOUGH, LIKELY)}
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
