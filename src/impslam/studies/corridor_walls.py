"""Count the walls that extractors find along the corridor, and the spurious ones among them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from impslam.component import build
from impslam.config import load
from impslam.extractors.base import Extractor
from impslam.sensors.lidar2d import Lidar2D
from impslam.studies.corridor_truth import Classification, corridor_truth, judge
from impslam.studies.ground_truth import true_twist
from impslam.studies.report import load_text
from impslam.sweeps.rows import Row
from impslam.types import LaserScan, Message

EXTRACTORS: Mapping[str, Mapping[str, Any]] = load_text("corridor")["extractors"]
EVERY = 10
"""Every n-th scan is given to the extractors: one per second, or 0.6 m of the drive."""
COUNTS = ("scans", "walls", "spurious", "of_people", "scans_with_spurious")
"""Counts for each extractor: scans, walls in them, spurious ones (see `corridor_truth.is_wall`), those of
people among these, and scans with a spurious wall."""


def count_walls(
    messages: Sequence[Message], seed: int, every: int = EVERY
) -> dict[str, Counter[str]]:
    """Return `COUNTS` of every extractor on every n-th scan, de-skewed with the true motion."""
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


def tally(walls: Sequence[Classification]) -> dict[str, int]:
    """Return `COUNTS` of the walls of one scan."""
    spurious = [wall for wall in walls if wall.false]
    people = sum(wall.person for wall in spurious)
    return dict(
        zip(COUNTS, (1, len(walls), len(spurious), people, int(bool(spurious))), strict=True)
    )


def total_counts(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    """Return the sums of `COUNTS` of every extractor over all rows that contain them."""
    counted = [row for row in rows if f"{next(iter(EXTRACTORS))}: {COUNTS[0]}" in row]
    return {
        name: {what: sum(row[f"{name}: {what}"] for row in counted) for what in COUNTS}
        for name in EXTRACTORS
    }
