"""The report's section on errors, where the truth is known."""

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
    Pairs,
    align,
    associate,
    ate,
    heading_errors,
    interpolate,
    is_same_pose,
    move,
    position_errors,
    start_frame,
    statistics,
)
from impslam.geometry.se2 import inverse
from impslam.observers.history import History
from impslam.observers.page import Line, chart, escape, section, table, tiles
from impslam.types import Array, Landmark, TrueLandmark

SHOWN = (
    ("x error in cm", "a", 100.0),
    ("y error in cm", "b", 100.0),
    ("Heading error in degrees", "c", math.degrees(1.0)),
)
"""Charts of the pose's errors: title, look, and the unit's size."""

NOTES = {
    "map": "It is given in map.",
    "start": "Its frame is aligned with the first pose, to which the covariances refer.",
    "fit": "It has no heading at the start, so its frame is aligned by the best fit of the path.",
}


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """Estimate and truth side by side in map, the motion that laid the truth there, and how."""

    pairs: Pairs
    T_map_truth: Array
    how: Literal["map", "start", "fit"]


def laid_in_map(history: History) -> Laid | None:
    """Return estimate and truth side by side, the truth in map; None without a truth.

    A tracking system has a frame of its own. Its truth is then laid so that both begin at the same
    pose, which is where the filter's covariance begins, too; or, if the truth tells no heading there,
    where the paths fit best.
    """
    if not len(history.true_path) or not len(history.path):
        return None
    try:
        pairs = associate(history.path, history.true_path)
    except ImpError:
        return None
    if is_same_pose(pairs.estimate[0], pairs.truth[0]):
        return Laid(pairs, np.zeros(3), "map")
    T_truth_map = start_frame(pairs, float(history.path[0, 0]))
    fitted = T_truth_map is None
    if T_truth_map is None:
        T_truth_map = align(pairs.estimate[:, :2], pairs.truth[:, :2])
    T_map_truth = inverse(T_truth_map)
    here = Pairs(pairs.stamps, pairs.estimate, move(T_map_truth, pairs.truth))
    return Laid(here, T_map_truth, "fit" if fitted else "start")


def section_of(
    laid: Laid | None,
    history: History,
    landmarks: Sequence[Landmark],
    known: Sequence[TrueLandmark],
) -> str:
    """Return the section, empty where nothing is known."""
    parts = []
    note = "The truth comes from the log or the simulated world; the filter never sees it."
    if laid is not None:
        note += " " + NOTES[laid.how]
        known = transform_landmarks(laid.T_map_truth, known)
        if len(laid.pairs.stamps) > 1:
            parts += [_figures(laid, history), _charts(laid, history)]
    if known:
        parts.append(_landmarks(score_landmarks(landmarks, known), landmarks, known))
    return section("Errors against the truth", *parts, note=note) if parts else ""


def _figures(laid: Laid, history: History) -> str:
    pairs = laid.pairs
    alone = associate(history.odometry, np.column_stack((pairs.stamps, pairs.truth)))
    raw, aligned, wheels = ate(pairs, aligned=False), ate(pairs), ate(alone)
    turn = statistics(heading_errors(pairs))
    facts = {
        "Path error (ATE)": (metres(aligned.rmse), f"RMS, aligned; at most {metres(aligned.max)}"),
        "From the start": (metres(raw.rmse), f"RMS, not aligned; at most {metres(raw.max)}"),
        "Odometry alone": (metres(wheels.rmse), "RMS, aligned"),
        "Heading error": (f"{math.degrees(turn.rmse):.2f}°", "RMS"),
        "End position": (metres(float(position_errors(pairs)[-1])), "off at the last scan"),
    }
    if not turn.count:
        del facts["Heading error"]
    if laid.how == "fit":  # the covariance does not count from there
        del facts["From the start"]
    elif normalised := _nees(pairs, history):
        facts["NEES of the pose"] = normalised
    return tiles(facts)


def _nees(pairs: Pairs, history: History) -> tuple[str, str] | None:
    P, errors = _at(history, pairs.stamps), pose_errors(pairs.estimate, pairs.truth)
    dof = 3 if np.isfinite(errors).all() else 2
    P, errors = P[:, :dof, :dof], errors[:, :dof]
    sure = np.linalg.eigvalsh(P)[:, 0] > 1e-14  # not the first pose, which is so by definition
    if not sure.any():
        return None
    values = nees(errors[sure], P[sure])
    high = chi2_bounds(dof)[1]
    inside = 100.0 * np.mean(values < high)
    ideal = "ideal 3" if dof == 3 else "of the position; ideal 2"
    return f"{values.mean():.1f}", f"{ideal}; {inside:.1f} % below {high:.1f}, ideal 97.5 %"


def _at(history: History, stamps: Array) -> Array:
    rows = np.isin(history.path[:, 0], stamps)
    return history.covariances[rows]


def _charts(laid: Laid, history: History) -> str:
    pairs, t = laid.pairs, laid.pairs.stamps
    error = pose_errors(pairs.estimate, pairs.truth)
    sigma = np.sqrt(np.maximum(np.diagonal(_at(history, t), axis1=1, axis2=2), 0.0))
    counts = laid.how != "fit"  # or the covariance counts from another place
    charts = []
    for i, (name, look, unit) in enumerate(SHOWN):
        if np.isfinite(error[:, i]).any():
            band = 3.0 * unit * sigma[:, i] if counts else None
            title = f"{name}, band 3σ" if counts else name
            charts.append(chart(title, t, [Line("", unit * error[:, i], look)], band))
    true = np.column_stack((pairs.stamps, pairs.truth))
    dead = interpolate(history.odometry, pairs.stamps) - true[:, 1:]
    lines = [
        Line("SLAM", 100 * position_errors(pairs), "a"),
        Line("odometry", 100 * np.hypot(dead[:, 0], dead[:, 1]), "b"),
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
            *(error.name, error.kind, _place(truth[error.name].position)),
            *(_place(marks[error.id].position), metres(error.distance)),
            *(f"{math.degrees(error.angle):.2f}°" if error.angle else "", metres(error.foot)),
        )
        for error in score.found
    ]
    rows += [
        (name, truth[name].kind, _place(truth[name].position), "missing", "", "", "")
        for name in score.missing
    ]
    header = ("landmark", "kind", "true x, y in m", "estimate", "error", "angle", "of the foot")
    said = (
        f"{len(score.found)} of {len(known)} found, {len(score.false)} false, "
        f"{len(score.doubles)} double. The error of a wall is taken across it, at its middle; x, y "
        "is the foot of its normal from the origin."
    )
    return f'<h2>Landmarks against the truth</h2><p class="note">{escape(said)}</p>' + table(
        header, rows, text=2
    )


def _place(position: Array) -> str:
    return f"{position[0]:z.3f}, {position[1]:z.3f}"


def metres(value: float) -> str:
    """Return a length in the unit that suits it."""
    return f"{100.0 * value:.1f} cm" if value < 1.0 else f"{value:.2f} m"
