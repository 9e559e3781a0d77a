"""Figures of the thesis's Chapter IV, from simulated scans that are selected by rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from matplotlib.figure import Figure

from impslam.evaluation.plots import as_png
from impslam.studies import chapter4_plot as plot
from impslam.studies.chapter4_detections import (
    LONG,
    MAX_DISTANCE,
    FoundByExtractor,
    ScanDetections,
    ThesisExtractors,
    doubles,
    first_or_nearest,
    jumps,
    long_ones,
    on_people,
    rates,
)
from impslam.studies.chapter4_hough import POOL, hough_figure
from impslam.studies.chapter4_jumps import jumps_figure
from impslam.studies.chapter4_scans import ARENA, CLEAR, CORRIDOR, PEOPLE, snapshots, world_of
from impslam.studies.report import Picture, Section, load_text
from impslam.sweeps.job import Job

SEED = 0
WORLDS = (ARENA, CORRIDOR, PEOPLE)
TEXT = load_text("chapter4")


@dataclass(frozen=True, slots=True)
class Chosen:
    """A scan to draw, and whether it satisfies the rule by which it was selected."""

    detections: ScanDetections
    occurs: bool = True

    def counts(self) -> dict[str, float]:
        """Return counts of the scan for the report."""
        detections, snapshot = self.detections, self.detections.snapshot
        return {
            "scan": snapshot.number,
            "time": snapshot.time,
            "true": len(detections.true),
            "spurious": len(detections.spurious),
            "long_spurious": len(long_ones(detections)),
            "doubles": doubles(detections),
            "on_legs": snapshot.on_legs,
            "occurs": self.occurs,
        }


def figures(job: Job) -> Section:
    """Draw the figures of Chapter IV from one run of seed 0; `job.seeds` is ignored."""
    thesis = ThesisExtractors.presets()

    def extract(world: str) -> FoundByExtractor:
        return thesis.detect(list(snapshots(world_of(world), SEED)))

    # A few seconds in total: starting processes would take as long.
    made = replace(job, processes=1).map(extract, WORLDS, "scans of three worlds")
    found = dict(zip(WORLDS, made, strict=True))
    chosen = choose(found)
    numbers = {
        world: {name: rates(scans) for name, scans in by_extractor.items()}
        for world, by_extractor in found.items()
    }
    return Section(
        "figures",
        TEXT["title"],
        _text(numbers),
        pictures=_pictures(chosen, found, thesis),
        numbers={"scans": {name: c.counts() for name, c in chosen.items()}, "runs": numbers},
    )


def choose(found: Mapping[str, FoundByExtractor]) -> dict[str, Chosen]:
    """Return the scan of each figure, by the figure's name."""
    arena, corridor, people = (found[world] for world in WORLDS)
    fewest_lost = sorted(arena["jump"], key=lambda d: int((~d.snapshot.scan.valid).sum()))
    clean = first_or_nearest(
        fewest_lost, lambda d: len(d.true) >= 2 and not d.spurious, _true_less_spurious
    )
    low = first_or_nearest(
        corridor["low"], lambda d: len(d.true) >= 1 and len(d.spurious) >= 2, _spurious
    )
    good = first_or_nearest(
        arena["ransac"],
        lambda d: len(d.true) >= 3 and not d.spurious and not doubles(d),
        _true_less_spurious,
    )
    bad = first_or_nearest(arena["ransac"], lambda d: bool(long_ones(d)), _spurious)
    hough = Chosen(arena["hough"][bad[0].snapshot.number])
    return {
        "fig11-jumps": Chosen(*clean),
        "fig12-camera": Chosen(*low),
        "fig13-spurious-cylinders": Chosen(*low),
        "fig14-filtered-cylinders": Chosen(corridor["filtered"][low[0].snapshot.number]),
        "fig15-ransac": Chosen(*good),
        "fig16-ransac-spurious": Chosen(*bad),
        "fig17-hough": hough,
        "fig17-hough-accumulator": hough,
        "fig18-hough-people": _most_on_legs(people),
        "fig19-hough-people": _most_on_legs(corridor),
    }


def _true_less_spurious(detections: ScanDetections) -> int:
    return len(detections.true) - doubles(detections) - 2 * len(detections.spurious)


def _spurious(detections: ScanDetections) -> int:
    return len(detections.spurious)


def _most_on_legs(found: FoundByExtractor) -> Chosen:
    return Chosen(
        max(found["hough"], key=lambda d: d.snapshot.on_legs if d.snapshot.is_clear else 0)
    )


def _pictures(
    chosen: Mapping[str, Chosen], found: Mapping[str, FoundByExtractor], thesis: ThesisExtractors
) -> list[Picture]:
    """Draw the scans, with their captions."""
    jump = thesis.jump

    def draw_jumps(shown: ScanDetections) -> Figure:
        seen = jumps(shown.snapshot.scan, jump.threshold)
        return jumps_figure(shown, seen, jump.threshold, jump.radius)

    draw: dict[str, Callable[[ScanDetections], Figure]] = {
        "jumps": draw_jumps,
        "camera": plot.camera_figure,
        "cylinders": lambda shown: plot.scan_figure(shown, jump.radius),
        "walls": plot.scan_figure,
        "accumulator": lambda shown: hough_figure(shown, thesis.hough),
        "people": plot.people_figure,
    }
    return [
        Picture(
            name,
            as_png(draw[TEXT[name]["draw"]](one.detections), **plot.PNG),
            _caption(TEXT[name], one, found, thesis),
        )
        for name, one in chosen.items()
    ]


def _caption(
    text: Mapping[str, str],
    chosen: Chosen,
    found: Mapping[str, FoundByExtractor],
    thesis: ThesisExtractors,
) -> str:
    """Return a figure's caption with its values filled in."""
    shown, snapshot = chosen.detections, chosen.detections.snapshot
    world = snapshot.scene.world.name
    facts: dict[str, Any] = {
        **thesis.by_name(),
        "found": _finds(shown),
        "on_people": on_people(shown),
        "on_legs": snapshot.on_legs,
        "long_ones": len(long_ones(shown)),
        "lost": "" if snapshot.scan.valid.all() else text.get("lost", ""),
        "long": LONG,
        "clear": CLEAR,
        "pool": POOL,
    }
    if "other" in text:
        facts["other"] = _finds(found[world][text["other"]][snapshot.number])
    if "what" in text:
        rule = {key: text[key].format(**facts) for key in ("which", "what")}
        at = f"{world}, {snapshot.time:.0f} s"
        facts["where"] = TEXT["where" if chosen.occurs else "nowhere"].format(at=at, **rule)
    return text["caption"].format(**facts)


def _finds(detections: ScanDetections) -> str:
    twice = doubles(detections)
    again = f" ({twice} of them a second line on the same wall)" if twice else ""
    return f"{len(detections.true)} true{again}, {len(detections.spurious)} spurious"


def _text(runs: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    def lines(extractor: str) -> str:
        each = []
        for world in (ARENA, PEOPLE, CORRIDOR):
            rate = runs[world][extractor]
            all_, long_ = rate["spurious_per_scan"], rate["long_spurious_per_scan"]
            each.append(f"{all_:.2f} ({long_:.2f}) in the {world}")
        return ", ".join(each)

    corridor = {name: f"{rate['spurious_per_scan']:.2f}" for name, rate in runs[CORRIDOR].items()}
    facts = corridor | {name: lines(name) for name in ("ransac", "hough")}
    text: str = TEXT["text"].format(seed=SEED, same=MAX_DISTANCE, long=LONG, **facts)
    return text
