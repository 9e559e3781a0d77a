"""Metrics of a drive through the corridor: its path, its map, and what the extractors find."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from impslam.component import build
from impslam.config import load
from impslam.evaluation.landmarks import score_landmarks
from impslam.extractors.base import Extractor
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation.world import World, load_world
from impslam.studies.corridor_truth import CorridorTruth, Verdict, false_landmarks, judge
from impslam.studies.ground_truth import true_twist
from impslam.studies.report import load_text
from impslam.studies.sweep import Run, Variant, grid
from impslam.sweeps.cases import ROBOT
from impslam.sweeps.rows import Row
from impslam.types import Landmark, LaserScan, Message

TEXT = load_text("corridor")
DEFAULT, HOUGH, FROM_ROBOT, _, RANSAC = TEXT["variants"]
VARIANTS = [
    Variant(name, table["preset"], tuple(table.get("settings", ())))
    for name, table in TEXT["variants"].items()
]
READINGS = grid(["thesis-lines"], TEXT["readings"])
EXTRACTORS: Mapping[str, Mapping[str, Any]] = TEXT["extractors"]
WITHIN = 0.005
"""Of the distance travelled: the end is to be this near."""
EVERY = 10
"""Of so many scans one is given to the extractors alone: a second, 0.6 m of the drive."""
COUNTS = ("scans", "walls", "spurious", "of_people", "scans_with_spurious")
"""What is counted of each extractor: scans looked at, walls seen in them, those that are none (see
`corridor_truth.is_wall`), of these the ones that rest on people, and scans with a spurious wall."""


@functools.cache
def corridor_world() -> World:
    """Return the world."""
    return load_world("corridor")


@functools.cache
def corridor_truth() -> CorridorTruth:
    """Return what is there, for the lidar of the robot that drives."""
    assert ROBOT.lidar is not None
    return CorridorTruth(corridor_world(), ROBOT.lidar)


def corridor_metrics(run: Run) -> Row:
    """Return what is measured of a run, beyond the errors of its path.

    `holds` is the distance driven before the path was `WITHIN` of the whole off for the first time, m.
    Of all landmarks that ever were in
    the map: `landmarks_ever`, `people_ever`, `touched_by_people` and `false_at_birth`, as they were when
    they entered. `false_at_the_end` are ids of the final map's landmarks, `missing` names of true ones,
    of the kinds that the map is made of. The default's rows also hold the extractors' counts, as
    `NAME: COUNT`.
    """
    verdicts = [_at_birth(run, number) for number in range(len(run.promotions))]
    kinds = {promotion.observation.kind for promotion in run.promotions}
    row = {
        "holds": distance_held(run, WITHIN * float(run.travelled[-1])),
        "landmarks_ever": len(verdicts),
        "people_ever": sum(verdict.person for verdict in verdicts),
        "touched_by_people": sum(verdict.touched for verdict in verdicts),
        "false_at_birth": sum(verdict.false for verdict in verdicts),
        "false_at_the_end": false_landmarks(corridor_truth(), run.landmarks),
        "missing": _missing(run.landmarks, kinds),
    }
    if run.variant.name == DEFAULT:
        for name, counts in count_walls(run.messages, run.seed).items():
            row |= {f"{name}: {what}": counts[what] for what in COUNTS}
    return row


def distance_held(run: Run, off: float) -> float:
    """Return how far the robot drove before the path was so far off for the first time, m."""
    lost = np.flatnonzero(run.errors > off)
    return float(run.travelled[lost[0] if len(lost) else -1])


def _at_birth(run: Run, number: int) -> Verdict:
    """Return what a landmark was when it entered the map."""
    _, stamp, observation = run.promotions[number]
    truth = corridor_truth()
    return judge(truth.sweep(stamp - run.messages[0].stamp), observation)


def _missing(landmarks: Sequence[Landmark], kinds: Collection[str]) -> tuple[str, ...]:
    known = [mark for mark in corridor_world().landmarks() if mark.kind in kinds]
    return score_landmarks(landmarks, known).missing


def count_walls(
    messages: Sequence[Message], seed: int, every: int = EVERY
) -> dict[str, Counter[str]]:
    """Return `COUNTS` of every extractor on one of so many scans, de-skewed with the true motion."""
    extractors: dict[str, Extractor] = {
        name: build("extractor", table) for name, table in EXTRACTORS.items()
    }
    counts = {name: Counter(dict.fromkeys(COUNTS, 0)) for name in extractors}
    truth, rng = corridor_truth(), np.random.default_rng(seed)
    sensor = load("imp").make_robot().sensors["lidar"]
    assert isinstance(sensor, Lidar2D)
    for message in [message for message in messages if isinstance(message, LaserScan)][::every]:
        time = message.stamp - messages[0].stamp
        scan = sensor.scan(message, true_twist(truth.path, time, time + truth.duration))
        sweep = truth.sweep(time)
        for name, extractor in extractors.items():
            walls = extractor.extract(scan, rng)
            counts[name].update(tally([judge(sweep, wall) for wall in walls]))
    return counts


def tally(walls: Sequence[Verdict]) -> dict[str, int]:
    """Return `COUNTS` of the walls of one scan."""
    spurious = [wall for wall in walls if wall.false]
    people = sum(wall.person for wall in spurious)
    return dict(
        zip(COUNTS, (1, len(walls), len(spurious), people, int(bool(spurious))), strict=True)
    )


def total_counts(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    """Return `COUNTS` of every extractor over all rows that hold them."""
    counted = [row for row in rows if f"{next(iter(EXTRACTORS))}: {COUNTS[0]}" in row]
    return {
        name: {what: sum(row[f"{name}: {what}"] for row in counted) for what in COUNTS}
        for name in EXTRACTORS
    }
