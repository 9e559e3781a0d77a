"""What `imp evaluate` does: runs compared with the truth, with measured relations, with themselves."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from impslam.cli.comparison import (
    short_names,
    show_innovations,
    show_landmarks,
    show_paths,
    show_quality,
    show_relations,
)
from impslam.cli.comparison_json import kind_facts, path_facts, relation_facts, write_json
from impslam.cli.evaluate import Against
from impslam.errors import ConfigError, ImpError
from impslam.evaluation.consistency import Innovations, score_innovations
from impslam.evaluation.landmark_files import read_true_landmarks
from impslam.evaluation.landmarks import corners
from impslam.evaluation.options import Alignment
from impslam.evaluation.quality import Quality, quality
from impslam.evaluation.relations import RelationErrors, read_relations, relation_errors
from impslam.evaluation.run_files import RecordedRun, read_run
from impslam.evaluation.scores import KindScore, PathScore, score_kinds, score_path
from impslam.evaluation.tum import read_tum
from impslam.paths import written
from impslam.types import Array, TrueLandmark

log = logging.getLogger(__name__)
DRAWN: dict[Alignment, str] = {
    "fit": "fitted to the truth",
    "start": "laid on the true start",
    "none": "as given",
}


@dataclass(frozen=True, slots=True, eq=False)
class Yardsticks:
    """The content of those files; None where nothing was given."""

    truth: Array | None
    landmarks: list[TrueLandmark] | None
    relations: Array | None
    how: Against


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What one run scores; None where it was not compared."""

    place: Path
    run: RecordedRun
    path: PathScore | None
    kinds: list[KindScore] | None
    relations: RelationErrors | None
    innovations: Innovations | None
    quality: Quality | None


def compare(
    runs: Sequence[Path], against: Against, output: Path | None, json: Path | None, quiet: bool
) -> None:
    """Print how runs compare, write the numbers, draw the picture."""
    yardsticks = _read(against)
    places = list(dict.fromkeys(runs))
    scores = dict(_scored(zip(short_names(places), places, strict=True), yardsticks))
    if not quiet:
        _show(scores, yardsticks)
    if json is not None:
        write_json(json, _facts(scores, yardsticks))
    if output is not None:
        _draw(scores, against.align, output)


def _read(against: Against) -> Yardsticks:
    truth, landmarks, relations = against.truth, against.landmarks, against.relations
    return Yardsticks(
        None if truth is None else read_tum(truth),
        None if landmarks is None else read_true_landmarks(landmarks),
        None if relations is None else read_relations(relations),
        against,
    )


def _scored(places: Iterable[tuple[str, Path]], by: Yardsticks) -> Iterator[tuple[str, Scores]]:
    """Yield the scores of the runs that can be compared, and say of the others why they cannot.

    Raises
    ------
    ImpError
        If none can, or one cannot be read.
    """
    failed: list[ImpError] = []
    compared = 0
    for name, place in places:
        run = read_run(place)
        try:
            yield name, _score(place, run, by)
            compared += 1
        except ImpError as error:
            failed.append(error)
    if not compared:
        raise failed[0]
    for left in failed:
        log.warning("left out: %s", left)


def _score(place: Path, run: RecordedRun, by: Yardsticks) -> Scores:
    """Compare a run with what there is to compare it with."""
    truth = run.truth if by.truth is None else by.truth
    known = run.true_landmarks if by.landmarks is None else by.landmarks
    if by.landmarks is not None and run.landmarks is None:
        raise ConfigError(f"{place}: contains no landmarks.csv; omit --landmarks")
    if truth is None and by.relations is None and by.landmarks is None and run.known is None:
        raise ConfigError(
            f"{place}: contains neither a truth nor a map.imp; give --truth FILE (TUM) or "
            "--relations FILE"
        )
    try:
        path = None if truth is None else score_path(run, truth, by.how.align, by.how.delta)
        relations = None if by.relations is None else relation_errors(run.path, by.relations)
    except ImpError as error:
        raise ImpError(f"{place}: {error}") from None
    kinds = None
    if known and run.landmarks is not None:
        kinds = score_kinds(run.landmarks, [*known, *_corners(known)], path, by.how.gate)
    if run.known is None:
        return Scores(place, run, path, kinds, relations, None, None)
    seen = score_innovations(run.known.keyframes.innovations)
    return Scores(place, run, path, kinds, relations, seen, quality(run.known))


def _corners(known: list[TrueLandmark]) -> list[TrueLandmark]:
    """Return the corners that true walls imply, unless corners were surveyed."""
    return [] if any(true.kind == "corner" for true in known) else corners(known)


def _show(scores: Mapping[str, Scores], by: Yardsticks) -> None:
    paths, kinds, relations = _by_yardstick(scores)
    if paths:
        show_paths(paths, by.how.align, by.how.delta)
    if kinds:
        show_landmarks(kinds, by.how.gate, _frame(bool(paths), by.how.align))
    if relations:
        show_relations(relations)
    if seen := {name: score.innovations for name, score in scores.items() if score.innovations}:
        show_innovations(seen)
    if own := {name: score.quality for name, score in scores.items() if score.quality}:
        show_quality(own)


def _by_yardstick(
    scores: Mapping[str, Scores],
) -> tuple[dict[str, PathScore], dict[str, list[KindScore]], dict[str, RelationErrors]]:
    """Return the scores by what they are of, of the runs that have them."""
    return (
        {name: score.path for name, score in scores.items() if score.path},
        {name: score.kinds for name, score in scores.items() if score.kinds},
        {name: score.relations for name, score in scores.items() if score.relations},
    )


def _frame(has_path: bool, align: Alignment) -> str:
    """Say where landmarks were compared."""
    if not has_path or align == "none":
        return "the truth taken to be in map"
    return "the truth laid in map by the path's " + ("best fit" if align == "fit" else "start")


def _facts(scores: Mapping[str, Scores], by: Yardsticks) -> dict[str, Any]:
    """Return all numbers, by the runs as they were named."""
    runs = {}
    for score in scores.values():
        runs[str(score.place)] = {
            "poses": len(score.run.path),
            "path": path_facts(score.path) if score.path else None,
            "landmarks": kind_facts(score.kinds) if score.kinds else None,
            "relations": relation_facts(score.relations) if score.relations else None,
            "innovations": score.innovations,
            "quality": score.quality.figures() if score.quality else None,
        }
    return {"align": by.how.align, "delta_m": by.how.delta, "gate_m": by.how.gate, "runs": runs}


def _draw(scores: Mapping[str, Scores], align: Alignment, output: Path) -> None:
    from impslam.evaluation.comparison_plot import (
        draw_comparison,
    )

    paths, _, relations = _by_yardstick(scores)
    trajectories = {name: score.run.path for name, score in scores.items()}
    figure = draw_comparison(trajectories, paths, relations, DRAWN[align])
    with written(output, "choose another -o", ConfigError):
        figure.savefig(output, metadata={"Software": None})
