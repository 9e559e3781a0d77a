"""Writes the run folder, with fixed file names; equal runs give equal bytes except for times."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.landmark_files import TRUE_LANDMARKS, write_true_landmarks
from impslam.evaluation.tum import TRUTH, write_tum
from impslam.map import Map
from impslam.maps.files import map_image
from impslam.observers.base import Outcome
from impslam.observers.history import History
from impslam.observers.map_files import write_map_files
from impslam.observers.report import write_report
from impslam.observers.summary import config_toml, summarise
from impslam.observers.trajectory import LIVE_PATH
from impslam.observers.write_attempts import WriteAttempts
from impslam.paths import replacements, written
from impslam.types import Array, TrueLandmark

NO_TRUTH = np.empty((0, 4))


def make_run_folder(folder: Path) -> None:
    """Create the folder of a run if it does not exist.

    Raises
    ------
    ImpError
        If it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImpError(
            f"{folder}: cannot be created ({error.strerror}); choose another -o"
        ) from None


def begin_summary(folder: Path) -> None:
    """Write a summary that marks the run as partial, in case it is killed; `write_end` replaces it.

    It also reserves space for the final one, in case the disk is full by then.

    Raises
    ------
    ImpError
        If it cannot be written.
    """
    path = folder / "summary.json"
    with written(path, "choose another -o"):
        path.write_text(json.dumps({"partial": "the run has not ended"}) + "\n", encoding="utf-8")


def write_run(
    folder: Path,
    known: Map,
    outcome: Outcome,
    true_path: Array = NO_TRUTH,
    true_landmarks: Sequence[TrueLandmark] = (),
) -> Path:
    """Write all files of a run to a folder and return the folder; create it if it does not exist.

    `true_path` (m, 4) has the columns stamp, x, y, theta; it is empty if the log has no ground truth.

    Raises
    ------
    ImpError
        If a file cannot be written; then none is, and the files of an earlier run stay.
    """
    make_run_folder(folder)
    with written(folder, "free disk space or check the folder"), replacements(folder) as part:
        attempt = WriteAttempts(part, folder)
        with attempt(LIVE_PATH):
            write_tum(part / LIVE_PATH, known.live_path())
        if len(true_path):
            with attempt(TRUTH):
                write_tum(part / TRUTH, true_path)
        write_end(attempt, known, outcome, true_path, true_landmarks)
    return folder


def write_end(
    attempt: WriteAttempts,
    known: Map,
    outcome: Outcome,
    true_path: Array,
    true_landmarks: Sequence[TrueLandmark],
) -> None:
    """Write the files that are not written during the run; see `write_run`.

    The map comes first, because the other files can be made from it; the summary comes last and reports
    the files that could not be written.
    """
    folder, history = attempt.folder, History(known, true_path)
    if outcome.log.is_relative_to(folder):  # the folder may be moved together with its log
        outcome = replace(outcome, log=outcome.log.relative_to(folder))
    with attempt("map.imp"):
        known.save(folder / "map.imp")
    grid = known.grid(outcome.config["grid"]["resolution"])
    image, refused = map_image(grid), grid.refused
    del grid  # free its memory for the picture
    write_map_files(folder, known, image, attempt, outcome.health.states)
    with attempt("odometry.tum"):
        write_tum(folder / "odometry.tum", history.odometry)
    if true_landmarks:
        with attempt(TRUE_LANDMARKS):
            write_true_landmarks(folder / TRUE_LANDMARKS, true_landmarks)
    with attempt("config.toml"):
        (folder / "config.toml").write_text(config_toml(outcome.config), encoding="utf-8")
    with attempt("report.png", "report.html"):
        write_report(folder, history, _marked(outcome, attempt), image, true_landmarks)
    with attempt("summary.json"):
        facts = summarise(_marked(outcome, attempt), history, refused)
        text = json.dumps(facts, indent=2, ensure_ascii=False) + "\n"
        (folder / "summary.json").write_text(text, encoding="utf-8")
    attempt.check()


def _marked(outcome: Outcome, attempt: WriteAttempts) -> Outcome:
    """Return the outcome, marked as partial if a file could not be written."""
    partial = "; ".join(filter(None, (outcome.partial, attempt.message)))
    return replace(outcome, partial=partial)
