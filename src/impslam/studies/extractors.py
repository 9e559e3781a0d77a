"""All extractors on the same labelled scans, against the Cramér-Rao bound.

After Nguyen, Martinelli, Tomatis and Siegwart 2005, "A comparison of line extraction algorithms
using 2D laser rangefinder for indoor mobile robotics": speed, completeness, correctness and
precision, on scans whose every beam is labelled, so that nothing is judged by hand.
"""

from __future__ import annotations

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
from impslam.studies.extractor_scores import known_association, score_scan
from impslam.studies.extractor_stats import ExtractorScore
from impslam.studies.extractor_tables import TEXT, accuracy_table, detection_table, numbers
from impslam.studies.labelled_scans import (
    DRIVING,
    PEOPLE,
    STANDING,
    LabelledScan,
    labelled_scans,
)
from impslam.studies.report import Picture, Section
from impslam.sweeps.job import Job
from impslam.types import Scan

SEEDS = 3
WORLDS = ("arena", "room", "corridor")
CONDITIONS = (STANDING, DRIVING, PEOPLE)
KINDS = ("wall", "cylinder")
SCANS = 60  # of a world, a seed and a condition
TIMED = 20  # of a world and a condition
ROUNDS = 5  # of timing
KNOWN = "true beams"

Scores: TypeAlias = dict[str, dict[str, ExtractorScore]]
"""By extractor and condition."""


def extractors(job: Job) -> Section:
    """Compare all wall and all cylinder extractors; `Job.seeds` times three worlds."""
    items = [(seed, world) for seed in range(job.seeds or SEEDS) for world in WORLDS]
    parts = job.map(compare, items, "labelled scans")
    scores = {kind: _merged([part[kind] for part in parts]) for kind in KINDS}
    # One after the other: what is timed is to have a core for itself.
    timed = replace(job, processes=1).map(_speeds, KINDS, "speed")
    speeds = dict(zip(KINDS, timed, strict=True))
    return Section(
        "extractors",
        TEXT["title"],
        TEXT["text"],
        [
            table
            for kind in KINDS
            for table in (
                detection_table(kind, scores[kind], speeds[kind]),
                accuracy_table(kind, scores[kind]),
            )
        ],
        [_picture(scores)],
        {kind: numbers(scores[kind], speeds[kind]) for kind in KINDS},
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
    preset, where = TEXT["thesis"][kind]
    thesis = build("extractor", load(preset).sensors["lidar"]["extractors"][where])
    if thesis not in found.values():
        found[f"{thesis.name}, thesis"] = thesis
    for label, table in TEXT["variants"].items():
        variant: Extractor = build("extractor", table)
        if variant.landmark == kind:
            found[label] = variant
    return dict(sorted(found.items()))


def compare(item: tuple[int, str]) -> dict[str, Scores]:
    """Score every contender on the scans of a seed in a world; return the scores by kind."""
    seed, world = item
    out: dict[str, Scores] = {kind: {} for kind in KINDS}
    for condition in CONDITIONS:
        scans = list(labelled_scans(load_world(world), condition, seed, SCANS))
        for kind in KINDS:
            for label, extractor in contenders(kind).items():
                out[kind].setdefault(label, {})[condition.name] = score(extractor, scans, seed)
            if condition == STANDING:  # with errors other than noise, a fit is not optimal
                best = [score_scan(scan, kind, known_association(scan, kind)) for scan in scans]
                out[kind][KNOWN] = {condition.name: ExtractorScore.of(best)}
    return out


def score(extractor: Extractor, scans: Sequence[LabelledScan], seed: int) -> ExtractorScore:
    """Score an extractor on scans; `seed` is for randomised extractors."""
    rng, radius = np.random.default_rng(seed), getattr(extractor, "radius", None)
    return ExtractorScore.of(
        [score_scan(s, extractor.landmark, extractor.extract(s.scan, rng), radius) for s in scans]
    )


def speed(some: Mapping[str, Extractor], scans: Sequence[Scan]) -> dict[str, float]:
    """Return scans per second on one core: the median of several rounds over all extractors.

    Processor time is measured, so that other programs on the machine hardly matter. Every extractor gets
    new copies of the scans, without cached results of the others.
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
    """Return scans per second by contender and condition, for a few scans of every world."""
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


def _merged(parts: Sequence[Scores]) -> Scores:
    """Return the scores of all seeds and worlds together."""
    first = parts[0]
    return {
        label: {
            condition: reduce(add, (part[label][condition] for part in parts))
            for condition in conditions
        }
        for label, conditions in first.items()
    }


def _picture(scores: Mapping[str, Scores]) -> Picture:
    from impslam.studies.extractor_plot import draw  # noqa: PLC0415  # matplotlib: 0.3 s

    conditions = STANDING.name, DRIVING.name, PEOPLE.name
    return Picture("extractors", draw(scores, conditions, KNOWN), TEXT["picture"])
