"""`imp evaluate`: how far runs are from the truth, or from relations that people measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from impslam.cli.comparison import short_names, show_landmarks, show_paths, show_relations
from impslam.cli.console import Common
from impslam.errors import ConfigError, ImpError
from impslam.evaluation.landmark_files import read_true_landmarks
from impslam.evaluation.landmarks import GATE, corners
from impslam.evaluation.relations import RelationErrors, read_relations, relation_errors
from impslam.evaluation.run_files import RecordedRun, read_run
from impslam.evaluation.scores import Alignment, KindScore, PathScore, score_kinds, score_path
from impslam.evaluation.tum import read_tum
from impslam.types import Array, TrueLandmark


@dataclass(frozen=True, slots=True, eq=False)
class Yardsticks:
    """What runs are compared with, None where nothing was given, and how."""

    truth: Array | None
    landmarks: list[TrueLandmark] | None
    relations: Array | None
    align: Alignment
    delta: float
    gate: float


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What one run scores; None where it was not compared."""

    run: RecordedRun
    path: PathScore | None
    kinds: list[KindScore] | None
    relations: RelationErrors | None


def evaluate(
    *runs: Path,
    truth: Path | None = None,
    landmarks: Path | None = None,
    relations: Path | None = None,
    align: Alignment = "fit",
    delta: Annotated[float, Parameter(help="Stretch of the relative pose error, m.")] = 1.0,
    gate: Annotated[float, Parameter(help="How far off a landmark may be, m.")] = GATE,
    common: Common | None = None,
) -> None:
    """Print the errors of runs against the truth or against measured relations.

    Parameters
    ----------
    runs
        Folders of runs, or trajectories as TUM files; one row of the table each.
    truth
        The true path, as a TUM file. Default: the one in the run's folder.
    landmarks
        The true landmarks, as a CSV file. Default: those in the run's folder.
    relations
        A relation file of the SLAM benchmarking suite.
    align
        Compare where the path fits the truth best, laid on its start, or as it is given.
    """
    del common
    if not runs:
        raise ConfigError("no run given; name the folder of a run, or a trajectory as TUM file")
    if not delta > 0.0 or not gate > 0.0:
        raise ConfigError("--delta and --gate are lengths in m, greater than 0")
    yardsticks = Yardsticks(
        None if truth is None else read_tum(truth),
        None if landmarks is None else read_true_landmarks(landmarks),
        None if relations is None else read_relations(relations),
        align,
        delta,
        gate,
    )
    places = list(dict.fromkeys(runs))
    scores = {
        name: _score(place, yardsticks)
        for name, place in zip(short_names(places), places, strict=True)
    }
    _show(scores, yardsticks)


def _score(place: Path, by: Yardsticks) -> Scores:
    """Compare a run with what there is to compare it with."""
    run = read_run(place)
    truth = run.truth if by.truth is None else by.truth
    known = run.true_landmarks if by.landmarks is None else by.landmarks
    if by.landmarks is not None and run.landmarks is None:
        raise ConfigError(f"{place}: holds no landmarks.csv; leave out --landmarks")
    if truth is None and by.relations is None and by.landmarks is None:
        raise ConfigError(f"{place}: knows no truth; give --truth FILE (TUM) or --relations FILE")
    try:
        path = None if truth is None else score_path(run, truth, by.align, by.delta)
        relations = None if by.relations is None else relation_errors(run.path, by.relations)
    except ImpError as error:
        raise ImpError(f"{place}: {error}") from None
    kinds = None
    if known and run.landmarks is not None:
        kinds = score_kinds(run.landmarks, [*known, *_corners(known)], path, by.gate)
    return Scores(run, path, kinds, relations)


def _corners(known: list[TrueLandmark]) -> list[TrueLandmark]:
    """Return the corners that true walls imply, unless corners were surveyed."""
    return [] if any(true.kind == "corner" for true in known) else corners(known)


def _show(scores: dict[str, Scores], by: Yardsticks) -> None:
    paths = {name: score.path for name, score in scores.items() if score.path}
    kinds = {name: score.kinds for name, score in scores.items() if score.kinds}
    relations = {name: score.relations for name, score in scores.items() if score.relations}
    if paths:
        show_paths(paths, by.align, by.delta)
    if kinds:
        show_landmarks(kinds, by.gate, _frame(bool(paths), by.align))
    if relations:
        show_relations(relations)


def _frame(has_path: bool, align: Alignment) -> str:
    """Say where landmarks were compared."""
    if not has_path or align == "none":
        return "the truth taken to be in map"
    return "the truth laid in map by the path's " + ("best fit" if align == "fit" else "start")
