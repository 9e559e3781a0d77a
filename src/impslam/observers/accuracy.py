"""The report's section on errors, for runs with ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from impslam.errors import ImpError
from impslam.evaluation.consistency import chi2_bounds, nees, pose_errors
from impslam.evaluation.landmarks import LandmarkScore, score_landmarks, transform_landmarks
from impslam.evaluation.trajectory import (
    PosePairs,
    align,
    associate,
    ate,
    heading_errors,
    interpolate,
    position_errors,
    start_frame,
    statistics,
)
from impslam.geometry.chi_square import GATE_3D_999
from impslam.geometry.se2 import compose, inverse
from impslam.observers.history import History
from impslam.observers.page import ChartLine, chart, escape, section, table, tiles
from impslam.types import Array, Landmark, TrueLandmark

CHARTS = (
    ("x error in cm", "a", 100.0),
    ("y error in cm", "b", 100.0),
    ("Heading error in degrees", "c", math.degrees(1.0)),
)
"""Charts of the pose errors: title, line style, and the factor from m or rad to the title's unit."""

START_RESOLUTION = 1e-4
"""m and rad: accuracy to which a truth in the map frame contains the start of the run."""
NOTES = {
    "map": "It is given in the map frame.",
    "start": "It is aligned with the map at the first pose, to which the covariances refer.",
    "fit": "It has no heading at the start, so it is aligned with the map by the best fit of the path.",
}


@dataclass(frozen=True, slots=True, eq=False)
class AlignedTruth:
    """Pairs of estimated and true poses in map, the transform of the truth to map, and its origin."""

    pairs: PosePairs
    T_map_truth: Array
    how: Literal["map", "start", "fit"]


def align_truth(history: History) -> AlignedTruth | None:
    """Return pairs of estimated and true poses in map, or None without ground truth.

    A truth with a frame of its own, e.g. from a tracking system, is aligned at the first pose, where
    the filter's covariance begins; or by the best fit of the paths if it has no heading there. It is in map
    if the first poses agree within the covariance, as after the localisation in a map.
    """
    if not len(history.true_path) or not len(history.path):
        return None
    try:
        pairs = associate(history.path, history.true_path)
    except ImpError:
        return None
    if _is_in_map(pairs, _at(history, pairs.stamps)[0]):
        return AlignedTruth(pairs, np.zeros(3), "map")
    T_truth_map = start_frame(pairs, float(history.path[0, 0]))
    fitted = T_truth_map is None
    if T_truth_map is None:
        T_truth_map = align(pairs.estimate[:, :2], pairs.truth[:, :2])
    T_map_truth = inverse(T_truth_map)
    in_map = PosePairs(pairs.stamps, pairs.estimate, compose(T_map_truth, pairs.truth))
    return AlignedTruth(in_map, T_map_truth, "fit" if fitted else "start")


def _is_in_map(pairs: PosePairs, covariance: Array) -> bool:
    """Return whether the first estimated and true poses agree within a covariance (3, 3)."""
    error = pose_errors(pairs.estimate[:1], pairs.truth[:1])
    values = nees(error, covariance[None] + START_RESOLUTION**2 * np.eye(3))
    return bool(values[0] < GATE_3D_999)  # not if the heading is unknown


def accuracy_section(
    aligned: AlignedTruth | None,
    history: History,
    landmarks: Sequence[Landmark],
    known: Sequence[TrueLandmark],
) -> str:
    """Return the section, or "" without ground truth."""
    parts = []
    note = "The truth comes from the log or the simulated world; the filter does not use it."
    if aligned is not None:
        note += " " + NOTES[aligned.how]
        known = transform_landmarks(aligned.T_map_truth, known)
        if len(aligned.pairs.stamps) > 1:
            parts += [_figures(aligned, history), _charts(aligned, history)]
    if known:
        parts.append(_landmarks(score_landmarks(landmarks, known), landmarks, known))
    return section("Errors against the truth", *parts, note=note) if parts else ""


def _figures(aligned: AlignedTruth, history: History) -> str:
    pairs = aligned.pairs
    odometry = associate(history.odometry, np.column_stack((pairs.stamps, pairs.truth)))
    raw, fitted, wheels = ate(pairs, aligned=False), ate(pairs), ate(odometry)
    turn = statistics(heading_errors(pairs))
    facts = {
        "Path error (ATE)": (metres(fitted.rmse), f"RMS, aligned; at most {metres(fitted.max)}"),
        "From the start": (metres(raw.rmse), f"RMS, not aligned; at most {metres(raw.max)}"),
        "Odometry": (metres(wheels.rmse), "RMS, aligned"),
        "Heading error": (f"{math.degrees(turn.rmse):.2f}°", "RMS"),
        "End position": (metres(float(position_errors(pairs)[-1])), "off at the last scan"),
    }
    if not turn.count:
        del facts["Heading error"]
    if aligned.how == "fit":  # the covariance refers to another frame
        del facts["From the start"]
    elif normalised := _nees(pairs, history):
        facts["NEES of the pose"] = normalised
    return tiles(facts)


def _nees(pairs: PosePairs, history: History) -> tuple[str, str] | None:
    P, errors = _at(history, pairs.stamps), pose_errors(pairs.estimate, pairs.truth)
    dof = 3 if np.isfinite(errors).all() else 2
    P, errors = P[:, :dof, :dof], errors[:, :dof]
    # unlike the first pose, which is exact by definition
    regular = np.linalg.eigvalsh(P)[:, 0] > 1e-14
    if not regular.any():
        return None
    values = nees(errors[regular], P[regular])
    high = chi2_bounds(dof)[1]
    inside = 100.0 * np.mean(values < high)
    ideal = "ideal 3" if dof == 3 else "position only; ideal 2"
    return f"{values.mean():.2f}", f"{ideal}; {inside:.1f} % below {high:.1f}, ideal 97.5 %"


def _at(history: History, stamps: Array) -> Array:
    rows = np.isin(history.path[:, 0], stamps)
    return history.covariances[rows]


def _charts(aligned: AlignedTruth, history: History) -> str:
    pairs, t = aligned.pairs, aligned.pairs.stamps
    error = pose_errors(pairs.estimate, pairs.truth)
    sigma = np.sqrt(np.maximum(np.diagonal(_at(history, t), axis1=1, axis2=2), 0.0))
    has_band = aligned.how != "fit"  # else the covariance refers to another frame
    charts = []
    for i, (name, style, unit) in enumerate(CHARTS):
        if np.isfinite(error[:, i]).any():
            band = 3.0 * unit * sigma[:, i] if has_band else None
            title = f"{name}, band 3σ" if has_band else name
            charts.append(chart(title, t, [ChartLine("", unit * error[:, i], style)], band))
    true = np.column_stack((pairs.stamps, pairs.truth))
    dead = interpolate(history.odometry, pairs.stamps) - true[:, 1:]
    lines = [
        ChartLine("SLAM", 100 * position_errors(pairs), "a"),
        ChartLine("odometry", 100 * np.hypot(dead[:, 0], dead[:, 1]), "b"),
    ]
    charts.append(chart("Distance from the truth in cm", t, lines))
    return f'<div class="charts">{"".join(charts)}</div>'


def _landmarks(
    score: LandmarkScore, landmarks: Sequence[Landmark], known: Sequence[TrueLandmark]
) -> str:
    marks = {mark.id: mark for mark in landmarks}
    truth = {true.name: true for true in known}
    rows = [
        (
            *(error.name, error.kind, _coordinates(truth[error.name].position)),
            *(_coordinates(marks[error.id].position), metres(error.distance)),
            *(f"{math.degrees(error.angle):.2f}°" if error.angle else "", metres(error.foot)),
        )
        for error in score.found
    ]
    rows += [
        (name, truth[name].kind, _coordinates(truth[name].position), "missing", "", "", "")
        for name in score.missing
    ]
    header = ("landmark", "kind", "true x, y in m", "estimate", "error", "angle", "of x, y")
    note = (
        f"{len(score.found)} of {len(known)} found, {len(score.false)} false, "
        f"{len(score.doubles)} double. The error of a wall is measured across it, at its midpoint; x, y "
        "is the point of its line nearest to the origin."
    )
    return f'<h2>Landmarks against the truth</h2><p class="note">{escape(note)}</p>' + table(
        header, rows, text=2
    )


def _coordinates(position: Array) -> str:
    return f"{position[0]:z.3f}, {position[1]:z.3f}"


def metres(value: float) -> str:
    """Return a length in cm, or in m from 1 m."""
    return f"{100.0 * value:.1f} cm" if value < 1.0 else f"{value:.2f} m"
