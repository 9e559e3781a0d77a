"""Measures of a run: errors against the truth, if known, and measures without truth."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from impslam.config import load
from impslam.evaluation.consistency import score_innovations
from impslam.evaluation.landmark_files import read_surveyed
from impslam.evaluation.quality import quality
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.evaluation.run_files import RecordedRun
from impslam.evaluation.scores import score_kinds, score_path
from impslam.evaluation.trajectory import associate, ate
from impslam.evaluation.tum import read_tum
from impslam.map import Map
from impslam.observers.base import Observer, Outcome
from impslam.observers.ending import EndOfRun
from impslam.observers.summary import length
from impslam.open_log import open_log
from impslam.run import Run, map_log
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sweeps.cases import ROBOT, SIMULATED, Case
from impslam.sweeps.likelihood import InnovationLikelihood
from impslam.sweeps.rows import Row, attempt
from impslam.types import Array, TrueLandmark

STRETCH = 1.0
"""m, length of the relative pose error."""


def run_case(case: Case) -> Row:
    """Map a log and return its row; see `measures` for the columns."""
    return attempt(case.row(), partial(_measured, case))


def _measured(case: Case) -> Row:
    log, end, likelihood = case.log, EndOfRun(), InnovationLikelihood()
    work, marks = (_simulated if log.is_world else _replayed)(case, [likelihood, end])
    begin = time.thread_time()
    work()
    seconds = time.thread_time() - begin
    assert end.known is not None
    assert end.outcome is not None
    truth = end.path if log.truth is None else read_tum(Path(log.truth))
    relations = None if log.relations is None else read_relations(Path(log.relations))
    row = measures(end.known, end.outcome, truth, marks, relations)
    return {**row, "nll": likelihood.mean, "cpu_s": seconds}


Prepared: TypeAlias = tuple[Callable[[], object], list[TrueLandmark]]
"""A function that maps a log, to be called once, and the true landmarks."""


def _replayed(case: Case, observers: Sequence[Observer]) -> Prepared:
    """Prepare the mapping of a log."""
    config, source = open_log(case.log.path, case.config, case.overrides)
    marks = source.true_landmarks() or read_surveyed(source.path)
    return partial(map_log, config, source, observers), marks


def _simulated(case: Case, observers: Sequence[Observer]) -> Prepared:
    """Simulate a drive with the case's seed, and prepare its mapping."""
    world = load_world(case.log.path)
    start = list(map(float, world.robot.start))
    config = load(case.config or SIMULATED, [f"start={start}", *case.overrides])
    messages = list(simulate(world, ROBOT, case.seed))

    def work() -> None:
        run = Run(config, observers)
        run.play(messages)
        known = run.refined()
        outcome = run.outcome(Path(case.log.name), "", len(known.landmarks))
        for observer in observers:
            observer.finish(known, outcome)

    return work, world.landmarks()


def measures(
    known: Map,
    outcome: Outcome,
    truth: Array,
    landmarks: Sequence[TrueLandmark] = (),
    relations: Array | None = None,
) -> Row:
    """Return the measures of a run by name; names end with the unit, shares and counts have none.

    An empty `truth` (m, 4) and empty `landmarks` add no measures. Errors are root mean squares after the
    rigid motion that fits the path to the truth best; relation errors are means.
    """
    run = RecordedRun(known.path(), known.rows().covariances, list(known.landmarks), known=known)
    row = _facts(known, outcome)
    if len(truth):
        row |= _path_errors(run, truth)
    if landmarks:
        row |= _landmark_errors(run, truth, landmarks)
    if relations is not None:
        errors = relation_errors(run.path, relations)
        row |= {
            "relation_m": float(errors.translation.mean()),
            "relation_rad": float(errors.rotation.mean()),
            "relations_missing": errors.missing,
        }
    return row | quality(known).figures()


def _facts(known: Map, outcome: Outcome) -> Row:
    """Return sizes, the shares of scans in each state of health, and the innovations' mean NIS."""
    states = outcome.health.counts()
    total = max(1, sum(states.values()))
    innovations = score_innovations(known.keyframes.innovations)
    return {
        "scans": len(known.stamps),
        "keyframes": len(known.keyframes),
        "landmarks": len(known.landmarks),
        "path_m": length(known, known.path()),
        "log_s": outcome.log_seconds,
        "loops_closed": outcome.counts.get("loops closed"),
        **{name.lower(): count / total for name, count in states.items()},
        "matches": innovations.matches if innovations else 0,
        "nis_per_dof": innovations.mean if innovations else math.nan,
        "nis_within": innovations.within if innovations else math.nan,
    }


def _path_errors(run: RecordedRun, truth: Array) -> Row:
    score = score_path(run, truth, "fit", STRETCH)
    assert run.known is not None
    odometry = ate(associate(run.known.odometry(), truth))
    consistency, metres, radians = score.consistency, score.rpe_metres, score.rpe_radians
    return {
        "ate_m": score.aligned.rmse,
        "heading_rad": score.heading.rmse,
        "rpe_m": metres.rmse if metres else math.nan,
        "rpe_rad": radians.rmse if radians else math.nan,
        "odometry_ate_m": odometry.rmse,
        "nees_per_dof": consistency.mean / consistency.dof if consistency else math.nan,
        "nees_within": consistency.within if consistency else math.nan,
    }


def _landmark_errors(run: RecordedRun, truth: Array, landmarks: Sequence[TrueLandmark]) -> Row:
    path = score_path(run, truth, "fit", STRETCH) if len(truth) else None
    kinds = score_kinds(run.landmarks or [], landmarks, path)
    squares = [kind.distance.count * kind.distance.rmse**2 for kind in kinds if kind.distance.count]
    found = sum(kind.distance.count for kind in kinds)
    return {
        "landmarks_true": sum(kind.true for kind in kinds),
        "landmarks_missing": sum(kind.missing for kind in kinds),
        "landmarks_false": sum(kind.false for kind in kinds),
        "landmarks_double": sum(kind.doubles for kind in kinds),
        "landmarks_m": float(np.sqrt(sum(squares) / found)) if found else math.nan,
    }
