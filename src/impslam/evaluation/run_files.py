"""Read runs to score: the folder of a run, or a trajectory file of any program."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.landmark_files import TRUE_LANDMARKS, read_true_landmarks
from impslam.evaluation.tum import HEALTH_COLUMN, PATH_COLUMNS, TRUTH, read_numbers, read_tum
from impslam.map import SYMMETRIC, Map
from impslam.maps.landmark_table import read_landmarks
from impslam.types import Array, Landmark, TrueLandmark

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRun:
    """A run as read from its files; None for missing parts.

    `path` (n, 4) is stamp, x, y, theta; `covariances` (n, 3, 3) are those of its poses; `truth` (m, 4) and
    `true_landmarks` are in the log's own frame, the rest is in map. `known` is the whole map.
    """

    path: Array
    covariances: Array | None = None
    landmarks: list[Landmark] | None = None
    truth: Array | None = None
    true_landmarks: list[TrueLandmark] | None = None
    known: Map | None = None


def read_run(place: Path) -> RecordedRun:
    """Read the folder of a run, or a TUM file.

    Raises
    ------
    ImpError
        If there is no trajectory, or a file cannot be read.
    """
    if not place.exists():
        raise ImpError(f"{place}: no such run; give the folder of a run, or a TUM file")
    if not place.is_dir():
        return RecordedRun(
            read_tum(place, "give the folder of a run (`imp run LOG`), or a TUM file")
        )
    if not (place / "trajectory.tum").is_file():
        raise ImpError(f"{place}: contains no trajectory.tum; give the folder of a run")
    path = read_tum(place / "trajectory.tum")
    table, marks = place / "trajectory.csv", place / "landmarks.csv"
    truth, true_marks = place / TRUTH, place / TRUE_LANDMARKS
    known = Map.load(place / "map.imp") if (place / "map.imp").is_file() else None
    if known is not None and (partial := known.about.get("partial")):
        log.warning("%s: the run covers only a part of its log: %s", place, partial)
    return RecordedRun(
        path,
        _covariances(table, path) if table.is_file() else None,
        read_landmarks(marks) if marks.is_file() else None,
        read_tum(truth) if truth.is_file() else None,
        read_true_landmarks(true_marks) if true_marks.is_file() else None,
        known,
    )


def _covariances(table: Path, path: Array) -> Array:
    """Return the covariances (n, 3, 3) of the poses of a path (n, 4)."""
    with table.open(encoding="utf-8", errors="replace") as stream:
        has_health = stream.readline().rstrip().endswith(f",{HEALTH_COLUMN}")
    head, n = (f"{PATH_COLUMNS},{HEALTH_COLUMN}", 11) if has_health else (PATH_COLUMNS, 10)
    rows = np.array(list(read_numbers(table, n, head, head=head))).reshape(-1, n)
    if not np.array_equal(rows[:, 0], path[:, 0]):
        raise ImpError(f"{table}: has other stamps than trajectory.tum; run the log again")
    return rows[:, 4:10][:, SYMMETRIC].reshape(-1, 3, 3)
