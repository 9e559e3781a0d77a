"""Compares runs with the truth, measured relations and themselves for `imp evaluate`."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from impslam.cli.comparison import (
    show_innovations,
    show_landmarks,
    show_paths,
    show_quality,
    show_relations,
)
from impslam.cli.comparison_json import kind_facts, path_facts, relation_facts
from impslam.cli.output_files import write_json
from impslam.errors import ConfigError, ImpError
from impslam.evaluation.consistency import Innovations, score_innovations
from impslam.evaluation.landmark_files import read_true_landmarks
from impslam.evaluation.landmarks import corners
from impslam.evaluation.options import Alignment
from impslam.evaluation.quality import Quality, quality
from impslam.evaluation.relations import RelationErrors, read_relations, relation_errors
from impslam.evaluation.run_files import RecordedRun, read_run
from impslam.evaluation.scores import KindScore, PathScore, score_kinds, score_path
from impslam.evaluation.trajectory import misfit
from impslam.evaluation.tum import read_tum
from impslam.paths import short_names, write_bytes
from impslam.types import Array, TrueLandmark

if TYPE_CHECKING:
    from impslam.cli.evaluate import Against

log = logging.getLogger(__name__)
DRAWN: dict[Alignment, str] = {
    "fit": "fitted to the truth",
    "start": "aligned at the true start",
    "none": "as given",
}
"""Caption of the drawn paths by alignment."""
LANDMARK_FRAMES: dict[Alignment, str] = {
    "fit": "truth aligned with the map by the path's best fit",
    "start": "truth aligned with the map by the path's start",
    "none": "assuming that the truth is in the map frame",
}
"""How the true landmarks are aligned with the map."""

MAX_INTERPOLATION = 0.5
"""Share of a path's error up to which that of the interpolated truth hardly counts: it adds 13 %, because
the squares of independent errors add."""


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """The contents of the files to compare runs with; None for files that were not given."""

    truth: Array | None
    landmarks: list[TrueLandmark] | None
    relations: Array | None
    options: Against


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """The scores of a run; None for comparisons that were not made."""

    source: Path
    run: RecordedRun
    path: PathScore | None
    kinds: list[KindScore] | None
    relations: RelationErrors | None
    innovations: Innovations | None
    quality: Quality | None


def compare(
    runs: Sequence[Path], against: Against, output: Path | None, json: Path | None, quiet: bool
) -> None:
    """Score runs, print the tables, write the numbers and draw the picture."""
    references = _read(against)
    sources = list(dict.fromkeys(runs))
    scores = dict(_scored(zip(short_names(sources), sources, strict=True), references))
    if not quiet:
        _show(scores, references)
    if json is not None:
        write_json(json, _facts(scores, references))
    if output is not None:
        _draw(scores, against.align, output)


def _read(against: Against) -> References:
    truth, landmarks, relations = against.truth, against.landmarks, against.relations
    return References(
        None if truth is None else read_tum(truth),
        None if landmarks is None else read_true_landmarks(landmarks),
        None if relations is None else read_relations(relations),
        against,
    )


def _scored(
    sources: Iterable[tuple[str, Path]], references: References
) -> Iterator[tuple[str, Scores]]:
    """Yield the scores of the runs that can be compared, and warn about the others.

    Raises
    ------
    ImpError
        If no run can be compared, or a run cannot be read.
    """
    failed: list[ImpError] = []
    compared = 0
    for name, source in sources:
        run = read_run(source)
        try:
            yield name, _score(source, run, references)
            compared += 1
        except ImpError as error:
            failed.append(error)
    if not compared:
        raise failed[0]
    for reason in failed:
        log.warning("left out: %s", reason)


def _score(source: Path, run: RecordedRun, given: References) -> Scores:
    """Compare a run with the given references, and with those in its own folder."""
    options = given.options
    truth = run.truth if given.truth is None else given.truth
    known = run.true_landmarks if given.landmarks is None else given.landmarks
    if given.landmarks is not None and run.landmarks is None:
        raise ConfigError(f"{source}: contains no landmarks.csv; omit --landmarks")
    if truth is None and given.relations is None and given.landmarks is None and run.known is None:
        raise ConfigError(
            f"{source}: contains neither ground truth nor a map.imp; give --truth FILE (TUM) or "
            "--relations FILE"
        )
    try:
        path = None if truth is None else score_path(run, truth, options.align, options.delta)
        relations = None if given.relations is None else relation_errors(run.path, given.relations)
    except ImpError as error:
        raise ImpError(f"{source}: {error}") from None
    kinds = None
    if known and run.landmarks is not None:
        kinds = score_kinds(run.landmarks, [*known, *_corners(known)], path, options.gate)
    if run.known is None:
        return Scores(source, run, path, kinds, relations, None, None)
    innovations = score_innovations(run.known.keyframes.innovations)
    return Scores(source, run, path, kinds, relations, innovations, quality(run.known))


def _corners(known: list[TrueLandmark]) -> list[TrueLandmark]:
    """Return the corners implied by the true walls, unless corners were surveyed."""
    return [] if any(true.kind == "corner" for true in known) else corners(known)


def _show(scores: Mapping[str, Scores], references: References) -> None:
    options = references.options
    paths, kinds, relations = _by_kind(scores)
    if paths:
        show_paths(paths, options.align, options.delta)
        if others := [name for name in scores if name not in paths]:
            log.warning("no ground truth, so no errors of the path: %s", ", ".join(others))
        for name, score in paths.items():
            _warn_of_truth(name, score, len(scores[name].run.path))
    if kinds:
        align = options.align if paths else "none"
        show_landmarks(kinds, options.gate, LANDMARK_FRAMES[align], align)
    if relations:
        show_relations(relations)
    if found := {name: score.innovations for name, score in scores.items() if score.innovations}:
        show_innovations(found)
    if qualities := {name: score.quality for name, score in scores.items() if score.quality}:
        show_quality(qualities)


def _warn_of_truth(name: str, score: PathScore, total: int) -> None:
    """Warn of poses of a run without truth, and of a truth that is too sparse or cannot be right."""
    if lacking := total - len(score.pairs.stamps):
        log.warning(
            "%s: the truth lacks %d of %d poses, which are not scored", name, lacking, total
        )
    if score.interpolation > MAX_INTERPOLATION * score.aligned.rmse:
        log.warning(
            "%s: the truth has few poses: its linear interpolation is off by %.4f m (RMS), which all "
            "errors contain",
            *(name, score.interpolation),
        )
    if wrong := misfit(score.pairs):
        log.warning("%s: the truth %s", name, wrong)


def _by_kind(
    scores: Mapping[str, Scores],
) -> tuple[dict[str, PathScore], dict[str, list[KindScore]], dict[str, RelationErrors]]:
    """Return the scores of paths, landmarks and relations, each by run."""
    return (
        {name: score.path for name, score in scores.items() if score.path},
        {name: score.kinds for name, score in scores.items() if score.kinds},
        {name: score.relations for name, score in scores.items() if score.relations},
    )


def _facts(scores: Mapping[str, Scores], references: References) -> dict[str, Any]:
    """Return all numbers, keyed by the runs' paths as given."""
    runs = {}
    for score in scores.values():
        runs[str(score.source)] = {
            "poses": len(score.run.path),
            "path": path_facts(score.path) if score.path else None,
            "landmarks": kind_facts(score.kinds) if score.kinds else None,
            "relations": relation_facts(score.relations) if score.relations else None,
            "innovations": score.innovations,
            "quality": score.quality.figures() if score.quality else None,
        }
    how = references.options
    return {"align": how.align, "delta_m": how.delta, "gate_m": how.gate, "runs": runs}


def _draw(scores: Mapping[str, Scores], align: Alignment, output: Path) -> None:
    from impslam.evaluation.comparison_plot import draw_comparison
    from impslam.evaluation.plots import as_png

    paths, _, relations = _by_kind(scores)
    trajectories = {name: score.run.path for name, score in scores.items()}
    figure = draw_comparison(trajectories, paths, relations, DRAWN[align])
    write_bytes(output, as_png(figure))
