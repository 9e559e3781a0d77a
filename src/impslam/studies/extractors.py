"""All extractors on the same labelled scans, against the Cramér-Rao bound.

After Nguyen, Martinelli, Tomatis and Siegwart 2005, "A comparison of line extraction algorithms
using 2D laser rangefinder for indoor mobile robotics": speed, completeness, correctness and
precision, on scans whose every beam is labelled, so that nothing is judged by hand.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import add
from typing import TypeAlias, cast

import numpy as np

from impslam.component import build, components
from impslam.config import load
from impslam.extractors.base import Extractor
from impslam.simulation.world import load_world
from impslam.studies.extractor_scores import judge, known_association
from impslam.studies.extractor_stats import Tally
from impslam.studies.extractor_tables import (
    accuracy_table,
    detection_table,
    figures,
)
from impslam.studies.job import Job
from impslam.studies.labelled_scans import (
    DRIVING,
    PEOPLE,
    STANDING,
    LabelledScan,
    labelled_scans,
)
from impslam.studies.report import Picture, Section
from impslam.types import Scan

SEEDS = 3
WORLDS = ("arena", "room", "corridor")
CONDITIONS = (STANDING, DRIVING, PEOPLE)
KINDS = ("wall", "cylinder")
SCANS = 60  # of a world, a seed and a condition
TIMED = 20  # of a world and a condition
ROUNDS = 5  # of timing
KNOWN = "true beams"
THESIS = {"wall": ("thesis-lines", "walls"), "cylinder": ("thesis-points", "cylinders")}
"""Presets that hold the thesis's parameters, and the names of the extractors in them."""
VARIANTS = {
    "split_merge, flat": {"kind": "split_merge", "flatness": 0.0},
    "hough, 1° bins": {"kind": "hough", "angle_bin": math.radians(1.0)},
    "circle, radius known": {"kind": "circle", "radius": 0.1524},
}
"""What else is worth a row: each shows what one parameter costs or brings."""

Tallies: TypeAlias = dict[str, dict[str, Tally]]
"""By contender and condition."""


def extractors(job: Job) -> Section:
    """Compare all wall and all cylinder extractors; `Job.seeds` times three worlds."""
    items = [(seed, world) for seed in range(job.seeds or SEEDS) for world in WORLDS]
    parts = job.map(compare, items, "labelled scans")
    tallies = {kind: _merged([part[kind] for part in parts]) for kind in KINDS}
    job.progress("speed", 0, 1)
    speeds = {kind: _speeds(kind) for kind in KINDS}
    job.progress("speed", 1, 1)
    return Section(
        "extractors",
        "Extractors compared",
        TEXT,
        [
            table
            for kind in KINDS
            for table in (
                detection_table(kind, tallies[kind], speeds[kind]),
                accuracy_table(kind, tallies[kind]),
            )
        ],
        [_picture(tallies)],
        {kind: figures(tallies[kind], speeds[kind]) for kind in KINDS},
    )


def contenders(kind: str) -> Mapping[str, Extractor]:
    """Return the extractors of a kind of landmark: all registered, the thesis's, and variants.

    A plug-in takes part if it can be made without parameters.
    """
    found: dict[str, Extractor] = {
        name: build("extractor", {"kind": name})
        for name, cls in components("extractor").items()
        if cast("type[Extractor]", cls).landmark == kind
        and not any(field.is_required() for field in cls.model_fields.values())
    }
    preset, where = THESIS[kind]
    thesis = build("extractor", load(preset).sensors["lidar"]["extractors"][where])
    if thesis not in found.values():
        found[f"{thesis.name}, thesis"] = thesis
    for label, table in VARIANTS.items():
        variant: Extractor = build("extractor", table)
        if variant.landmark == kind:
            found[label] = variant
    return dict(sorted(found.items()))


def compare(item: tuple[int, str]) -> dict[str, Tallies]:
    """Return by kind what every contender makes of the scans of a seed in a world."""
    seed, world = item
    out: dict[str, Tallies] = {kind: {} for kind in KINDS}
    for condition in CONDITIONS:
        scans = list(labelled_scans(load_world(world), condition, seed, SCANS))
        for kind in KINDS:
            for label, extractor in contenders(kind).items():
                out[kind].setdefault(label, {})[condition.name] = tally(extractor, scans, seed)
            if condition == STANDING:  # faults other than noise ask for more than a fit
                best = [judge(scan, kind, known_association(scan, kind)) for scan in scans]
                out[kind][KNOWN] = {condition.name: Tally.of(best)}
    return out


def tally(extractor: Extractor, scans: Sequence[LabelledScan], seed: int) -> Tally:
    """Return what an extractor makes of some scans; `seed` is for those that sample."""
    rng, radius = np.random.default_rng(seed), getattr(extractor, "radius", None)
    return Tally.of(
        [judge(s, extractor.landmark, extractor.extract(s.scan, rng), radius) for s in scans]
    )


def speed(some: Mapping[str, Extractor], scans: Sequence[Scan]) -> dict[str, float]:
    """Return scans per second of one core, taken in turns, median of several rounds.

    Processor time is counted, so that other programs on the machine hardly matter. Every scan is
    new to every extractor: what one has computed is not there for the next.
    """
    seconds: dict[str, list[float]] = {label: [] for label in some}
    for number in range(ROUNDS + 1):
        for label, extractor in some.items():
            fresh = [replace(scan) for scan in scans]
            rng, begin = np.random.default_rng(0), time.process_time()
            for scan in fresh:
                extractor.extract(scan, rng)
            if number:  # the first round warms up
                seconds[label].append(time.process_time() - begin)
    return {label: len(scans) / float(np.median(s)) for label, s in seconds.items()}


def _speeds(kind: str) -> dict[str, dict[str, float]]:
    """Return scans per second by contender and condition, on a few scans of every world."""
    out: dict[str, dict[str, float]] = {}
    for condition in (DRIVING, PEOPLE):
        scans = [
            labelled.scan
            for world in WORLDS
            for labelled in labelled_scans(load_world(world), condition, 0, TIMED)
        ]
        for label, one in speed(contenders(kind), scans).items():
            out.setdefault(label, {})[condition.name] = one
    return out


def _merged(parts: Sequence[Tallies]) -> Tallies:
    """Return the tallies of all seeds and worlds together."""
    first = parts[0]
    return {
        label: {
            condition: reduce(add, (part[label][condition] for part in parts))
            for condition in conditions
        }
        for label, conditions in first.items()
    }


def _picture(tallied: Mapping[str, Tallies]) -> Picture:
    from impslam.studies.extractor_plot import draw  # noqa: PLC0415  # matplotlib: 0.3 s

    conditions = STANDING.name, DRIVING.name, PEOPLE.name
    return Picture("extractors", draw(tallied, conditions, KNOWN), CAPTION)


CAPTION = (
    "Typical (median) error over the Cramér-Rao bound against the number of beams that hit a wall or "
    "a cylinder, with 95 % intervals; the share that is found; and observations per scan of nothing "
    "that is there (filled) and of doors, boxes or legs (outlined), without people (dark) and with "
    "(light). Lines on bars are two standard errors to each side."
)
TEXT = (
    "All extractors on the same simulated scans of a URG-04LX, at places along the drives through "
    "the arena, the room and the corridor (after Nguyen et al. 2005). An exact ray tells what each "
    "beam hit, and so what is visible and what an observation is of.\n\n"
    "Standing: the robot stands and ranges have independent noise alone, as the Cramér-Rao bound "
    "supposes. The row of true beams is the maximum-likelihood fit to all beams that truly hit: it "
    "shows that the bound can be reached. Driving: at the drive's speed, de-skewed with the true motion, "
    "and with all faults: an error that all beams share, which the bound knows of, and mixed pixels "
    "at edges, lost beams and steps of 1 mm, which it does not. People: the same with two of them "
    "in sight of each scan.\n\n"
    "filtered_jump has the thesis's parameters by default, and hough but for its threshold of pixels: "
    "20, and 40 in the preset thesis-lines, which the thesis does not print. split_merge takes walls for "
    "straight to 5 mm and puts that into R, as real walls are no better; simulated ones are, so its "
    "NEES is low. The row without flatness shows that R is honest otherwise. A wall that an open "
    "door cuts, or that something hides over more than 1 m, comes in pieces: one counts as found, "
    "and is held against the bound of all of them, hence an RMS above the typical error and above "
    "that over the bound of its own beams. circle skips what is not seen from edge to edge, and "
    "what touches a wall, as the pillars of the corridor nearly do from afar; beams at its edges that "
    "are mixed with the background are lost to it, though not to the bound. jump, filtered_jump and "
    "the circle whose radius is known take 0.1524 m for it, which is true of the arena alone: "
    "elsewhere that circle refuses, and what the others find is not held against the bound.\n\n"
    "What to choose: split_merge for walls and circle for cylinders; both are about as good as the "
    "beams allow, say truly how good, and are hardly ever wrong. Where all cylinders have one radius, "
    "tell it to circle: it halves the error and refuses people's legs, which are as round as "
    "cylinders and are else for the lifecycle of landmarks to tell by their walking away. hough and "
    "ransac repeat the thesis. By default they give several false walls in ten scans, more with people; "
    "with the thesis preset's threshold hough is as good as free of them, and misses more. They are "
    "the further from the bound the more beams there are, since bins and bands do not shrink; finer "
    "bins help hough and slow it down. filtered_jump is hardly ever wrong but misses most; jump finds more "
    "and takes people for cylinders."
)
