"""The figures of the thesis's Chapter IV, from simulated scans that are chosen by rule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeAlias

from impslam.studies import chapter4_plot as plot
from impslam.studies.chapter4_hough import POOL, hough_figure
from impslam.studies.chapter4_scans import (
    ARENA,
    CLEAR,
    CORRIDOR,
    LONG,
    PEOPLE,
    SAME,
    Found,
    Sighting,
    Thesis,
    doubles,
    first,
    jumps,
    long_ones,
    on_people,
    rates,
    shots,
    world_of,
)
from impslam.studies.job import Job
from impslam.studies.report import Picture, Section

SEED = 0
WORLDS = (ARENA, CORRIDOR, PEOPLE)


def figures(job: Job) -> Section:
    """Draw the figures of Chapter IV; `job.seeds` does not matter: it is one run of seed 0."""
    thesis = Thesis.presets()

    def watch(world: str) -> Found:
        return thesis.look(list(shots(world_of(world), SEED)))

    # A few seconds in all: processes of their own would hardly have started by then.
    job = replace(job, processes=1)
    arena, corridor, people = job.map(watch, WORLDS, "scans of three worlds")
    drawn = [
        _jumps(arena, thesis),
        *_cylinders(corridor, thesis),
        *_ransac(arena),
        *_hough(arena, thesis),
        _people(people, "fig18-hough-people", "18"),
        _people(corridor, "fig19-hough-people", "19"),
    ]
    numbers = {
        world: {name: rates(seen) for name, seen in found.items()}
        for world, found in zip(WORLDS, (arena, corridor, people), strict=True)
    }
    return Section(
        "figures",
        "The figures of Chapter IV",
        _text(dict(zip(WORLDS, (arena, corridor, people), strict=True))),
        pictures=[picture for picture, _ in drawn],
        numbers={"scans": {p.name: counts for p, counts in drawn}, "runs": numbers},
    )


Drawn: TypeAlias = tuple[Picture, dict[str, float]]


def _text(found: Mapping[str, Found]) -> str:
    def per_scan(world: str, name: str, what: str = "spurious") -> str:
        return f"{rates(found[world][name])[f'{what}_per_scan']:.2f}"

    def lines(name: str) -> str:
        each = [
            f"{per_scan(world, name)} ({per_scan(world, name, 'long_spurious')}) in the {world}"
            for world in (ARENA, PEOPLE, CORRIDOR)
        ]
        return ", ".join(each)

    return (
        "What the thesis's extractors find in scans of the simulated URG-04LX, with the parameters "
        "of the presets thesis-points and thesis-lines; scans are 1 s apart, of one run of seed "
        f"{SEED}, and chosen by the rules that the captions say. The truth is drawn pale. A cylinder "
        f"counts as spurious if no true axis lies within {SAME:g} m of its centre; a wall if no flat "
        f"surface (wall or door, no box) of its direction, to 10°, comes within {SAME:g} m of the "
        "middle of its readings."
        "\n\n"
        f"Over the whole runs, spurious walls per scan (in brackets those of {LONG:g} m and more, longer "
        f"than any box or cylinder): RANSAC {lines('ransac')}; Hough {lines('hough')}. What the thesis "
        "says of Hough shows: people do not mislead it in the arena. What it pays for a threshold that "
        "no cylinder reaches are true walls that lie between two of its bins of angle."
        "\n\n"
        f"Spurious cylinders per scan of the corridor: {per_scan(CORRIDOR, 'low')} from jumps above "
        f"the low threshold, {per_scan(CORRIDOR, 'jump')} above the high one, "
        f"{per_scan(CORRIDOR, 'filtered')} after the filter."
    )


def _counts(sighting: Sighting, occurs: bool = True) -> dict[str, float]:
    return {
        "scan": sighting.shot.number,
        "time": sighting.shot.time,
        "true": len(sighting.true),
        "spurious": len(sighting.spurious),
        "long_spurious": len(long_ones(sighting)),
        "doubles": doubles(sighting),
        "on_legs": sighting.shot.on_legs,
        "occurs": occurs,
    }


def _where(sighting: Sighting, which: str, what: str, occurs: bool = True) -> str:
    """Say which scan it is, and by which rule: which one ("the first") of those with what."""
    at = f"{sighting.shot.scene.world.name}, {sighting.shot.time:.0f} s"
    if occurs:
        return f"Scan ({at}): {which} {what}."
    return f"It does not occur: no scan of this run is one {what}. This one ({at}) comes nearest."


def _clean(sighting: Sighting) -> int:
    return len(sighting.true) - doubles(sighting) - 2 * len(sighting.spurious)


def _spoiled(sighting: Sighting) -> int:
    return len(sighting.spurious)


def _jumps(arena: Found, thesis: Thesis) -> Drawn:
    clean = sorted(arena["jump"], key=lambda s: int((~s.shot.scan.valid).sum()))
    chosen, occurs = first(clean, lambda s: len(s.true) >= 2 and not s.spurious, _clean)
    which = "the one with the fewest beams lost (the thesis's arena lies within range) of those"
    threshold, radius = thesis.jump.threshold, thesis.jump.radius
    figure = plot.jumps_figure(chosen, jumps(chosen.shot.scan, threshold), threshold, radius)
    lost = " Lost beams, read as 0, jump as well: the drawback that the thesis names."
    caption = (
        "Thesis Fig. 11. Above the range by the angle of the beam, below its derivative: an object "
        f"begins where it falls below -{threshold:g} m/rad and ends where it rises above "
        f"+{threshold:g} m/rad (the scale is linear in between and logarithmic beyond). On the left "
        f"the cylinders that come of it.{'' if chosen.shot.scan.valid.all() else lost} Extractor "
        "jump, radius as in the preset thesis-points. "
        + _where(chosen, which, "with two true cylinders or more and no spurious one", occurs)
    )
    return Picture("fig11-jumps", plot.png(figure), caption), _counts(chosen, occurs)


def _cylinders(corridor: Found, thesis: Thesis) -> list[Drawn]:
    bad, occurs = first(
        corridor["low"], lambda s: len(s.true) >= 1 and len(s.spurious) >= 2, _spoiled
    )
    high = corridor["jump"][bad.shot.number]
    good = corridor["filtered"][bad.shot.number]
    what = "with a true cylinder and two spurious ones or more"
    spurious = (
        f"Thesis Fig. 13. Jumps above a low threshold ({thesis.low.threshold:g} m/rad) taken for "
        f"cylinders: {_finds(bad)}, {on_people(bad)} of these on the legs of people. Above "
        f"{thesis.jump.threshold:g} m/rad: {_finds(high)}. The circles have the radius that is "
        f"assumed, {thesis.jump.radius:g} m. Extractor jump. "
        + _where(bad, "the first", what, occurs)
    )
    filtered = (
        f"Thesis Fig. 14. The scan of Fig. 13 after the filters for count (at least "
        f"{thesis.filtered.min_points} readings), width (of a cylinder of "
        f"{thesis.filtered.radius:g} m) and curvature ({thesis.filtered.curvature:.0%}): "
        f"{_finds(good)}. Extractor filtered_jump, preset thesis-points."
    )
    radius = thesis.jump.radius
    return [
        (
            Picture("fig13-spurious-cylinders", plot.png(plot.scan_figure(bad, radius)), spurious),
            _counts(bad, occurs),
        ),
        (
            Picture("fig14-filtered-cylinders", plot.png(plot.scan_figure(good, radius)), filtered),
            _counts(good, occurs),
        ),
    ]


def _finds(sighting: Sighting) -> str:
    twice = doubles(sighting)
    again = f" ({twice} of them a second line on the same wall)" if twice else ""
    return f"{len(sighting.true)} true{again}, {len(sighting.spurious)} spurious"


def _ransac(arena: Found) -> list[Drawn]:
    good, fine = first(
        arena["ransac"], lambda s: len(s.true) >= 3 and not s.spurious and not doubles(s), _clean
    )
    bad, occurs = _across(arena)
    alike = "Extractor ransac, its own defaults (the thesis prints none). "
    right = (
        f"Thesis Fig. 15. Walls by RANSAC where it does well: {_finds(good)}. "
        + alike
        + _where(good, "the first", "with three true walls, none twice, and no spurious one", fine)
    )
    wrong = (
        f"Thesis Fig. 16. Walls by RANSAC where it fails: {_finds(bad)}, {len(long_ones(bad))} of "
        f"these of {LONG:g} m or more. A sample of readings on different things gives a line that "
        "enough others happen to lie near. "
        + alike
        + _where(bad, "the first", f"with a spurious wall of {LONG:g} m or more", occurs)
    )
    return [
        (Picture("fig15-ransac", plot.png(plot.scan_figure(good)), right), _counts(good, fine)),
        (
            Picture("fig16-ransac-spurious", plot.png(plot.scan_figure(bad)), wrong),
            _counts(bad, occurs),
        ),
    ]


def _across(arena: Found) -> tuple[Sighting, bool]:
    """Return the first scan in which RANSAC draws a wall across several things."""
    return first(arena["ransac"], lambda s: bool(long_ones(s)), _spoiled)


def _hough(arena: Found, thesis: Thesis) -> list[Drawn]:
    bad, _ = _across(arena)
    same = arena["hough"][bad.shot.number]
    walls = (
        "Thesis Fig. 17. Walls by the Hough transform in the scan in which RANSAC fails (Fig. 16): "
        f"{_finds(same)}. Directions come in steps of 10°, so that a wall's line may lie up to 5° "
        "askew. Extractor hough, preset thesis-lines: 10° and 2 cm bins."
    )
    image = (
        "The same scan as the Hough transform sees it (thesis 4.2.4). Left the binary image of "
        f"{thesis.hough.size} x {thesis.hough.size} px, the robot in its middle (Eq. 4.13); right "
        "the accumulator (Eq. 4.12), with rings about the cells of the walls that were found; "
        f"{POOL} distances are drawn as one cell, the strongest of them. A wall at an angle between two "
        "bins fills several cells; it is kept once."
    )
    return [
        (Picture("fig17-hough", plot.png(plot.scan_figure(same)), walls), _counts(same)),
        (
            Picture("fig17-hough-accumulator", plot.png(hough_figure(same, thesis.hough)), image),
            _counts(same),
        ),
    ]


def _people(found: Found, name: str, number: str) -> Drawn:
    chosen = max(found["hough"], key=lambda s: s.shot.on_legs if s.shot.is_clear else 0)
    other = found["ransac"][chosen.shot.number]
    caption = (
        f"Thesis Fig. {number}. The Hough transform with people in the scene: {_finds(chosen)}; "
        f"RANSAC in the same scan: {_finds(other)}. Extractor hough, preset thesis-lines; its "
        "directions come in steps of 10°. "
        + _where(
            chosen,
            f"the one with the most readings on legs ({chosen.shot.on_legs}) of those",
            f"with nobody nearer than {CLEAR:g} m",
        )
    )
    return Picture(name, plot.png(plot.people_figure(chosen)), caption), _counts(chosen)
