"""Metrics of a drive through the corridor: its path, and its map."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from impslam.evaluation.landmarks import score_landmarks
from impslam.studies.corridor_truth import (
    Classification,
    corridor_truth,
    corridor_world,
    false_landmarks,
    judge,
)
from impslam.studies.corridor_walls import COUNTS, count_walls
from impslam.studies.report import load_text
from impslam.studies.sweep import StudyRun, Variant, grid
from impslam.sweeps.rows import Row
from impslam.types import Landmark

TEXT = load_text("corridor")
DEFAULT, HOUGH, FROM_ROBOT, _, RANSAC = TEXT["variants"]
VARIANTS = [
    Variant(name, table["preset"], tuple(table.get("settings", ())))
    for name, table in TEXT["variants"].items()
]
READINGS = grid(["thesis-lines"], TEXT["readings"])
MAX_DRIFT = 0.005
"""Target error of the end, as a share of the distance travelled."""


def corridor_metrics(run: StudyRun) -> Row:
    """Return the metrics of a run beyond the errors of its path.

    `holds` is the distance driven before the error of the path first exceeds `MAX_DRIFT` of the whole, m.
    `landmarks_ever`, `people_ever`, `touched_by_people` and `false_at_birth` count all landmarks that were
    ever in the map, as they were when they entered. `false_at_the_end` are ids of landmarks of the final
    map, `missing` names of true ones, of the kinds in the map. The default's rows also contain the
    extractors' counts, as `NAME: COUNT`.
    """
    verdicts = [_at_birth(run, number) for number in range(len(run.promotions))]
    kinds = {promotion.observation.kind for promotion in run.promotions}
    row = {
        "holds": distance_held(run, MAX_DRIFT * float(run.travelled[-1])),
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


def distance_held(run: StudyRun, off: float) -> float:
    """Return the distance driven before the error of the path first exceeds `off`, m."""
    lost = np.flatnonzero(run.errors > off)
    return float(run.travelled[lost[0] if len(lost) else -1])


def _at_birth(run: StudyRun, number: int) -> Classification:
    """Classify a landmark at the time when it entered the map."""
    _, stamp, observation = run.promotions[number]
    truth = corridor_truth()
    return judge(truth.sweep(stamp - run.messages[0].stamp), observation)


def _missing(landmarks: Sequence[Landmark], kinds: Collection[str]) -> tuple[str, ...]:
    known = [mark for mark in corridor_world().landmarks() if mark.kind in kinds]
    return score_landmarks(landmarks, known).missing
