"""Tables that compare runs, one for each kind of score."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from impslam.cli import console
from impslam.cli.comparison_table import Cell, show
from impslam.evaluation.consistency import Innovations
from impslam.evaluation.options import Alignment
from impslam.evaluation.quality import Quality
from impslam.evaluation.relations import RelationErrors
from impslam.evaluation.scores import Consistency, KindScore, PathScore
from impslam.types import Array

ALIGNED = {"fit": "ATE", "start": "at start", "none": "as given"}
"""Name of the column of errors after alignment."""
NOTES = {
    "fit": "ATE: after the rigid motion that best fits the path to the truth",
    "start": "at start: with the first pose aligned to the true one",
    "none": "as given: assuming that the truth is in the map frame",
}


NEES_FRAMES = {
    "fit": "with the truth aligned at the start",
    "start": "with the truth aligned at the start",
    "none": "with the truth as given",
}
"""How the truth is aligned for normalised errors."""


def show_paths(scores: Mapping[str, PathScore], align_by: Alignment, delta: float) -> None:
    """Print the errors of paths against the truth."""
    name, rpe = ALIGNED[align_by], f"RPE/{delta:g} m"
    header = ["run", "poses", "unaligned, m", f"{name}, m", "max, m", "heading, deg"]
    header += [f"{rpe}, m", "deg", "NEES", "95 %", "within"]
    show(header, {(run,): _path_cells(score) for run, score in scores.items()})
    notes = [f"errors: root mean squares; unaligned: as the files are; {NOTES[align_by]}"]
    consistencies = [score.consistency for score in scores.values()]
    if any(consistencies):
        notes.append(_consistency_note([c for c in consistencies if c], align_by))
    if not all(consistencies):
        notes.append(
            "NEES -: needs covariances (a run folder) and a true heading within 1 s of the start"
        )
    if not all(score.heading.count for score in scores.values()):
        notes.append("heading, RPE -: the truth has positions only")
    for note in notes:
        console.echo(note)


def _consistency_note(known: Sequence[Consistency], align_by: Alignment) -> str:
    dofs = " or ".join(str(dof) for dof in sorted({c.dof for c in known}))
    two = "" if min(c.dof for c in known) == 3 else " (2: position only)"
    return (
        f"NEES: mean over poses, {NEES_FRAMES[align_by]}, ideal {dofs}{two}; 95 %: its "
        "interval for consistent covariances and correlated poses; within: share of poses in the "
        "interval of a single pose"
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
        *_consistency_cells(score.consistency),
    ]


def _number(value: float, digits: int) -> Cell:
    return Cell(f"{value:.{digits}f}" if math.isfinite(value) else "-", value)


def _length(value: float, digits: int = 4) -> Cell:
    return _number(value, digits)


def _angle(value: float, digits: int) -> Cell:
    return _number(math.degrees(value), digits)


def _consistency_cells(found: Consistency | None) -> tuple[Cell, Cell, Cell]:
    if found is None:
        return Cell("-"), Cell("-"), Cell("-")
    dof = "" if found.dof == 3 else " (2)"
    mean = Cell(f"{found.mean:.2f}{dof}", abs(math.log(max(found.mean, 1e-300) / found.dof)))
    interval = Cell(f"{found.low:.2f} to {found.high:.2f}")
    return mean, interval, Cell(f"{100.0 * found.within:.0f} %", abs(found.within - 0.95))


def show_landmarks(
    scores: Mapping[str, Sequence[KindScore]], gate: float, note: str, align_by: Alignment
) -> None:
    """Print how many true landmarks of each kind were matched, and their errors."""
    header = ["run", "kind", "true", "matched", "missing", "false", "double"]
    header += ["RMS, m", "max, m", "angle, deg", "NEES"]
    rows = {(run, s.kind): _kind_cells(s) for run, kinds in scores.items() for s in kinds}
    show(header, dict(sorted(rows.items(), key=lambda row: row[0][1])))
    console.echo(
        f"matched within {gate:g} m, {note}; walls: perpendicular distance at their midpoint; NEES: "
        f"{NEES_FRAMES[align_by]}, ideal 2"
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
    console.echo(
        "NIS: normalised innovation squared per degree of freedom, ideal 1, over keyframes with matches; "
        "needs no truth; 95 %: its interval for consistent covariances; within: share of keyframes in "
        "their own interval"
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
    """Print the errors of runs against measured relations."""
    header = ("run", "relations", "missing", "metres", "median", "degrees", "median")
    show(header, {(run,): _relation_cells(error) for run, error in errors.items()})


def show_quality(found: Mapping[str, Quality]) -> None:
    """Print how well the scans of runs agree with each other."""
    header = ["run", "disagreement, cm", "within", "between", "thickness"]
    header += ["contradicted", "doubled", "revisited"]
    show(header, {(run,): _quality_cells(q) for run, q in found.items()})
    console.echo(
        "disagreement: distance between scans of the same surface, mean of those within a pass and "
        "between passes; needs no truth, but does not detect a bent map if no place was revisited"
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
    """Return mean and standard deviation, as in the tables of the benchmarking suite."""
    mean = float(errors.mean())
    return Cell(f"{mean:.{digits}f} ± {errors.std():.{digits}f}", mean)
