"""Scores of a run: its path, its consistency, and its landmarks.

The truth has its own frame (motion capture, GPS); `T_truth_map` is the transform to it. By default, errors
are computed after fitting the path to the truth. The filter's covariances, however, are relative to the
start, which defines the map's origin: normalised errors are computed with the estimate aligned with the
true pose at the start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.consistency import (
    chi2_bounds,
    effective_count,
    nees,
    pose_errors,
    share_within,
)
from impslam.evaluation.landmarks import (
    LandmarkScore,
    landmark_errors,
    score_landmarks,
    transform_landmarks,
    true_kind,
)
from impslam.evaluation.options import GATE, Alignment
from impslam.evaluation.run_files import RecordedRun
from impslam.evaluation.trajectory import (
    PosePairs,
    Statistics,
    align,
    associate,
    ate,
    heading_errors,
    interpolation_error,
    rpe,
    start_frame,
    statistics,
)
from impslam.geometry.se2 import compose, inverse
from impslam.types import Array, Landmark, Mask, TrueLandmark

START_RADIUS = 1e-3
"""m from the start within which poses do not count: their covariance is meaningless."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """Normalised error squared of one run's poses, which are correlated in time.

    `dof`, the ideal value of `mean`, is 3, or 2 if only positions are known. For a consistent filter `mean`
    is between `low` and `high` in 95 % of runs, with the correlation taken into account. `within` is the
    share of the `count` poses inside the 95 % interval of the chi-square distribution.
    """

    dof: int
    count: int
    mean: float
    low: float
    high: float
    within: float


@dataclass(frozen=True, slots=True, eq=False)
class PathScore:
    """Errors of a path.

    Attributes
    ----------
    pairs : estimate and truth in the truth's frame, as aligned
    T_truth_map : (3,), the alignment
    T_truth_start : (3,), the alignment with the true pose at the start, used for covariances; or None
    given, aligned : m, absolute trajectory error as given, and after the alignment
    heading : rad
    rpe_metres, rpe_radians : relative pose error; None for a path shorter than the stretch
    consistency : None without covariances or without a true start
    interpolation : m, RMS error of the true positions, because they are interpolated; part of the errors
    """

    pairs: PosePairs
    T_truth_map: Array
    T_truth_start: Array | None
    given: Statistics
    aligned: Statistics
    heading: Statistics
    rpe_metres: Statistics | None
    rpe_radians: Statistics | None
    consistency: Consistency | None
    interpolation: float


@dataclass(frozen=True, slots=True)
class KindScore:
    """Counts and errors of the true landmarks of one kind.

    `distance` is in m (for walls: perpendicular, at the middle of the true wall), `angle` in rad between
    walls. `nees` is the mean over landmarks, ideally 2; NaN if unknown.
    """

    kind: str
    true: int
    missing: int
    false: int
    doubles: int
    distance: Statistics
    angle: Statistics
    nees: float


def score_path(run: RecordedRun, truth: Array, align_by: Alignment, delta: float) -> PathScore:
    """Compare a run with the true path (m, 4).

    Parameters
    ----------
    delta : m, stretch of the relative pose error

    Raises
    ------
    ImpError
        If they do not overlap in time, or the true start is requested but unknown.
    """
    pairs = associate(run.path, truth)
    start = np.zeros(3) if align_by == "none" else start_frame(pairs, float(run.path[0, 0]))
    if align_by == "fit":
        T_truth_map = align(pairs.estimate[:, :2], pairs.truth[:, :2])
    elif start is None:
        raise ImpError("the truth has no heading at the start of the run; leave out --align start")
    else:
        T_truth_map = start
    fitted = pairs.moved(T_truth_map)
    metres, radians = _relative(pairs, delta)
    consistency = None if start is None else _consistency(run, pairs, start)
    given, aligned = ate(pairs, aligned=False), ate(fitted, aligned=False)
    turn = statistics(heading_errors(fitted))
    sparse = interpolation_error(truth, pairs.stamps)
    errors = given, aligned, turn, metres, radians
    return PathScore(fitted, T_truth_map, start, *errors, consistency, sparse)


def _relative(pairs: PosePairs, delta: float) -> tuple[Statistics, Statistics] | tuple[None, None]:
    try:
        return rpe(pairs, delta)
    except ImpError:
        return None, None


def _consistency(run: RecordedRun, pairs: PosePairs, T_truth_map: Array) -> Consistency | None:
    """Return the consistency of a run, with the truth aligned to the map at the start."""
    values, dof = normalised_errors(run, pairs, T_truth_map)
    if not len(values):
        return None
    mean, bounds = float(values.mean()), chi2_bounds(dof, effective_count(values))
    return Consistency(dof, len(values), mean, *bounds, share_within(values, 1, dof))


def normalised_errors(run: RecordedRun, pairs: PosePairs, T_truth_map: Array) -> tuple[Array, int]:
    """Return the normalised error squared (n,) of the poses after leaving the start, and its dof.

    The dof are 3, or 2 if the truth has no headings. n is 0 if no covariance is invertible.
    """
    errors = pose_errors(pairs.estimate, compose(inverse(T_truth_map), pairs.truth))
    dof = 3 if np.isfinite(errors).all() else 2
    if run.covariances is None:
        return np.empty(0), dof
    covariances = run.covariances[np.isin(run.path[:, 0], pairs.stamps)]
    errors, covariances = errors[:, :dof], covariances[:, :dof, :dof]
    away = np.hypot(*(pairs.estimate[:, :2] - pairs.estimate[0, :2]).T) > START_RADIUS
    used = np.maximum.accumulate(away) & _regular(covariances)
    return nees(errors[used], covariances[used]), dof


def _regular(covariances: Array) -> Mask:
    """Return (n,) which covariances (n, k, k) are invertible."""
    return np.asarray(np.linalg.eigvalsh(covariances)[:, 0] > 0.0)


def score_kinds(
    landmarks: Sequence[Landmark],
    truth: Sequence[TrueLandmark],
    path: PathScore | None,
    gate: float = GATE,
) -> list[KindScore]:
    """Compare a map with true landmarks, kind by kind.

    Both are compared in map, using the path's alignment; without a path, the truth must be in map already.
    """
    here = truth if path is None else transform_landmarks(inverse(path.T_truth_map), truth)
    start = np.zeros(3) if path is None else path.T_truth_start
    counted = (
        {} if start is None else {t.name: t for t in transform_landmarks(inverse(start), truth)}
    )
    kinds = sorted({true.kind for true in truth})
    scores = []
    for kind in kinds:
        ours = [mark for mark in landmarks if true_kind(mark.kind, kinds) == kind]
        theirs = [true for true in here if true.kind == kind]
        score = score_landmarks(ours, theirs, gate)
        marks = {mark.id: mark for mark in ours}
        both = [(marks[e.id], counted[e.name]) for e in score.found if e.name in counted]
        scores.append(_kind_score(kind, len(theirs), score, _mean_nees(both)))
    return scores


def _kind_score(kind: str, true: int, score: LandmarkScore, mean_nees: float) -> KindScore:
    lost = len(score.missing), len(score.false), len(score.doubles)
    distance = statistics(np.array([error.distance for error in score.found]))
    angle = statistics(np.array([error.angle for error in score.found]))
    return KindScore(kind, true, *lost, distance, angle, mean_nees)


def _mean_nees(pairs: Sequence[tuple[Landmark, TrueLandmark]]) -> float:
    """Return the mean normalised error squared of landmarks; NaN if unknown."""
    errors = np.array([landmark_errors(mark, true) for mark, true in pairs]).reshape(-1, 2)
    covariances = np.array([mark.covariance for mark, _ in pairs]).reshape(-1, 2, 2)
    used = _regular(covariances)
    return float(nees(errors[used], covariances[used]).mean()) if used.any() else math.nan
