"""Runs side by side: a table for each kind of score."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from impslam.cli import console
from impslam.cli.comparison_table import Cell, show
from impslam.evaluation.consistency import Innovations
from impslam.evaluation.options import Alignment
from impslam.evaluation.quality import Quality
from impslam.evaluation.relations import RelationErrors
from impslam.evaluation.scores import Consistency, KindScore, PathScore
from impslam.types import Array

ALIGNED = {"fit": "aligned", "start": "at start", "none": "as given"}
"""How the columns are called whose errors are taken after an alignment."""
NOTES = {
    "fit": "aligned: after the rigid motion that fits the path to the truth best",
    "start": "at start: the first pose laid on the true one",
    "none": "as given: the truth is taken to be in map",
}


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return what differs between paths: their parts without those that all begin or end with."""
    parts = [list(path.parts) for path in paths]
    while len(paths) > 1 and len({tuple(p[:1]) for p in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [p[1:] for p in parts]
    while len(paths) > 1 and len({tuple(p[-1:]) for p in parts}) == 1 and min(map(len, parts)) > 1:
        parts = [p[:-1] for p in parts]
    if len(paths) == 1:
        parts = [p[-1:] or ["."] for p in parts]
    return [str(Path(*p)) for p in parts]


def show_paths(scores: Mapping[str, PathScore], align_by: Alignment, delta: float) -> None:
    """Print how far paths are from the truth."""
    name, stretch = ALIGNED[align_by], f"RPE/{delta:g} m"
    header = ["run", "poses", "ATE, m", f"{name}, m", "max, m", "heading, deg"]
    header += [f"{stretch}, m", "deg", "NEES", "95 %", "within"]
    show(header, {(run,): _path_cells(score) for run, score in scores.items()})
    notes = [f"ATE, RPE, heading: root mean squares; {NOTES[align_by]}"]
    sure = [score.consistency for score in scores.values()]
    if any(sure):
        notes.append(_consistency_note([c for c in sure if c]))
    if not all(sure):
        notes.append(
            "NEES -: needs covariances (a run folder) and a true heading within 1 s of the start"
        )
    if not all(score.heading.count for score in scores.values()):
        notes.append("heading, RPE -: the truth has positions only")
    for note in notes:
        console.say(note)


def _consistency_note(known: Sequence[Consistency]) -> str:
    dofs = " or ".join(str(dof) for dof in sorted({c.dof for c in known}))
    what = "" if min(c.dof for c in known) == 3 else " (2: of the position alone)"
    return (
        f"NEES: mean over poses from the true start, ideal {dofs}{what}; 95 %: where it lies if "
        "consistent, by chi-square and the correlation of steps; within: share in the interval of one pose"
    )


def _path_cells(score: PathScore) -> list[Cell]:
    metres, radians = score.rpe_metres, score.rpe_radians
    return [
        Cell(str(score.given.count)),
        _length(score.given.rmse),
        _length(score.aligned.rmse),
        _length(score.aligned.max),
        _angle(score.heading.rmse, 2),
        _length(metres.rmse if metres else math.nan),
        _angle(radians.rmse if radians else math.nan, 3),
        *_sure(score.consistency),
    ]


def _number(value: float, digits: int) -> Cell:
    return Cell(f"{value:.{digits}f}" if math.isfinite(value) else "-", value)


def _length(value: float, digits: int = 4) -> Cell:
    return _number(value, digits)


def _angle(value: float, digits: int) -> Cell:
    return _number(math.degrees(value), digits)


def _sure(sure: Consistency | None) -> tuple[Cell, Cell, Cell]:
    if sure is None:
        return Cell("-"), Cell("-"), Cell("-")
    dof = "" if sure.dof == 3 else " (2)"
    mean = Cell(f"{sure.mean:.2f}{dof}", abs(math.log(max(sure.mean, 1e-300) / sure.dof)))
    interval = Cell(f"{sure.low:.2f} to {sure.high:.2f}")
    return mean, interval, Cell(f"{100.0 * sure.within:.0f} %", abs(sure.within - 0.95))


def show_landmarks(scores: Mapping[str, Sequence[KindScore]], gate: float, note: str) -> None:
    """Print what became of the true landmarks of each kind."""
    header = ["run", "kind", "true", "matched", "missing", "false", "double"]
    header += ["RMS, m", "max, m", "angle, deg", "NEES"]
    rows = {(run, s.kind): _kind_cells(s) for run, kinds in scores.items() for s in kinds}
    show(header, dict(sorted(rows.items(), key=lambda row: row[0][1])))
    console.say(
        f"matched within {gate:g} m, {note}; walls: across, at their middle; NEES: ideal 2, from the "
        "true start"
    )


def _kind_cells(score: KindScore) -> list[Cell]:
    nees = score.nees
    off = abs(math.log(nees / 2.0)) if nees > 0.0 else math.nan
    counts = (score.missing, score.false, score.doubles)
    return [
        Cell(str(score.true)),
        Cell(str(score.distance.count), -score.distance.count),
        *(Cell(str(count), count) for count in counts),
        _length(score.distance.rmse),
        _length(score.distance.max),
        _angle(score.angle.rmse, 2) if score.angle.max else Cell(""),
        Cell(f"{nees:.2f}" if math.isfinite(nees) else "-", off),
    ]


def show_innovations(found: Mapping[str, Innovations]) -> None:
    """Print how consistent the innovations of runs are."""
    header = ("run", "keyframes", "matches", "NIS", "95 %", "within")
    show(header, {(run,): _innovation_cells(some) for run, some in found.items()})
    console.say(
        "NIS: innovations squared per degree of freedom, ideal 1, of keyframes with matches; it needs no "
        "truth; 95 %: where it lies if consistent, by chi-square; within: share of keyframes in their "
        "own interval"
    )


def _innovation_cells(found: Innovations) -> list[Cell]:
    return [
        Cell(str(found.count)),
        Cell(str(found.matches)),
        Cell(f"{found.mean:.3f}", abs(math.log(max(found.mean, 1e-300)))),
        Cell(f"{found.low:.3f} to {found.high:.3f}"),
        Cell(f"{100.0 * found.within:.0f} %", abs(found.within - 0.95)),
    ]


def show_relations(errors: Mapping[str, RelationErrors]) -> None:
    """Print how well runs keep measured relations."""
    header = ("run", "relations", "missing", "metres", "median", "degrees", "median")
    show(header, {(run,): _relation_cells(error) for run, error in errors.items()})


def show_quality(found: Mapping[str, Quality]) -> None:
    """Print how well the scans of runs agree with each other."""
    header = ["run", "disagreement, cm", "within", "between", "thickness"]
    header += ["contradicted", "doubled", "revisited"]
    show(header, {(run,): _quality_cells(q) for run, q in found.items()})
    console.say(
        "disagreement: how far scans of the same place are apart, mean of those within a pass and "
        "between passes; it needs no truth, and sees no bend where no place was revisited"
    )


def _quality_cells(found: Quality) -> list[Cell]:
    lengths = (found.disagreement, found.within, found.between, found.thickness)
    shares = (found.contradicted, found.doubled)
    return [
        *(_number(100.0 * length, 2) for length in lengths),
        *(_percent(share, 1) for share in shares),
        Cell(_percent(found.revisited, 0).text),
    ]


def _percent(share: float, digits: int) -> Cell:
    return Cell(f"{100.0 * share:.{digits}f} %" if math.isfinite(share) else "-", share)


def _relation_cells(errors: RelationErrors) -> list[Cell]:
    degrees = np.degrees(errors.rotation)
    return [
        Cell(str(len(errors.translation))),
        Cell(str(errors.missing), errors.missing),
        _spread(errors.translation, 3),
        _number(errors.metres.median, 3),
        _spread(degrees, 2),
        _number(float(np.median(degrees)), 2),
    ]


def _spread(errors: Array, digits: int) -> Cell:
    """Return mean and standard deviation, as the suite's tables give them."""
    mean = float(errors.mean())
    return Cell(f"{mean:.{digits}f} ± {errors.std():.{digits}f}", mean)
