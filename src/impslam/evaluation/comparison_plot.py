"""Figure that compares runs: paths, errors over time, and relation errors.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from impslam.errors import ImpError
from impslam.evaluation.colours import INK
from impslam.evaluation.plots import new_figure, quiet, shortened
from impslam.evaluation.relations import RelationErrors
from impslam.evaluation.scores import PathScore
from impslam.evaluation.trajectory import align, associate, position_errors
from impslam.geometry.se2 import compose
from impslam.types import Array, Ints

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
"""Okabe and Ito 2008: safe for colour-blind readers. Further runs differ by their dashes."""
DASHES: tuple[Any, ...] = ("-", (0, (4, 1.5)), (0, (1, 1)))
TRUTH = "#c3cad1"
WIDTH = 9.0
"""inches: 900 pixels as displayed, at twice that resolution."""
LOG_RATIO = 10.0
"""Ratio of errors from which on the scale is logarithmic, so that small ones remain visible."""

MIN_ERROR = 1e-3
"""m: smaller relation errors do not matter; the relations were not measured more accurately."""


def draw_comparison(
    runs: Mapping[str, Array],
    paths: Mapping[str, PathScore],
    relations: Mapping[str, RelationErrors],
    where: str,
) -> Figure:
    """Return the figure; save it with `figure.savefig(path)`.

    Parameters
    ----------
    runs : name -> (n, 4) stamp, x, y, theta; drawn in their own frame only if there is no truth
    paths : scores of runs that were compared with a truth
    relations : errors of runs that were compared with relations
    where : the alignment of the paths, for the title
    """
    panels = 1 + bool(paths) + bool(relations)
    shown = [score.pairs.truth for score in paths.values()] or [run[:, 1:] for run in runs.values()]
    heights = [_height(np.vstack(shown)), *[2.8] * (panels - 1)]
    figure = new_figure(WIDTH, 0.6 + sum(heights), dpi=200)
    axes: list[Axes] = list(figure.subplots(panels, 1, height_ratios=heights, squeeze=False)[:, 0])
    styles = _styles(list(runs))
    below = iter(axes[1:])
    if paths:
        holes = {name: _holes(runs[name], score) for name, score in paths.items()}
        _draw_paths(axes[0], paths, styles, holes)
        axes[0].set_title(f"Paths, {where}", color=INK, fontsize=10)
        _draw_errors(next(below), paths, styles, holes)
    else:
        _draw_runs(axes[0], runs, styles)
    if relations:
        _draw_relations(next(below), relations, styles)
    axes[0].set(xlabel="x in m", ylabel="y in m")
    axes[0].set_aspect("equal", adjustable="datalim")
    for panel in axes:
        quiet(panel)
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=min(4, len(runs) + 1),
        frameon=False,
    )
    return figure


def _height(poses: Array) -> float:
    """Return the height of the map of poses (n, 3), inches."""
    width, height = np.ptp(poses[:, :2], axis=0)
    return WIDTH * float(np.clip(height / max(width, 1e-9), 0.35, 0.7))


def _styles(names: list[str]) -> dict[str, dict[str, Any]]:
    """Return the line style of each run, by its name."""
    return {
        name: {
            "color": COLOURS[i % len(COLOURS)],
            "ls": DASHES[i // len(COLOURS) % len(DASHES)],
            "label": shortened(name),
            "lw": 1.4,
        }
        for i, name in enumerate(names)
    }


def _draw_paths(
    axes: Axes, paths: Mapping[str, PathScore], styles: Mapping[str, Any], holes: Mapping[str, Ints]
) -> None:
    """Draw the truth, and the estimates in its frame; leave gaps where there is no truth."""
    for i, (name, score) in enumerate(paths.items()):
        true = np.insert(score.pairs.truth[:, :2], holes[name], np.nan, axis=0)
        axes.plot(*true.T, color=TRUTH, lw=4.0, zorder=1, label="" if i else "truth")
    for name, score in paths.items():
        path = np.insert(score.pairs.estimate[:, :2], holes[name], np.nan, axis=0)
        axes.plot(*path.T, **styles[name])


def _draw_runs(axes: Axes, runs: Mapping[str, Array], styles: Mapping[str, Any]) -> None:
    """Draw paths without a truth, each fitted to the first one."""
    first = next(iter(runs.values()))
    for name, run in runs.items():
        axes.plot(*_fitted(run, first)[:, :2].T, **styles[name])
    title = "Paths, each fitted to the first" if len(runs) > 1 else "Path"
    axes.set_title(title, color=INK, fontsize=10)


def _fitted(run: Array, first: Array) -> Array:
    """Return poses (n, 3) of a run, fitted to another one if they overlap in time."""
    try:
        pairs = associate(run, first)
    except ImpError:
        return run[:, 1:]
    return compose(align(pairs.estimate[:, :2], pairs.truth[:, :2]), run[:, 1:])


def _draw_errors(
    axes: Axes, paths: Mapping[str, PathScore], styles: Mapping[str, Any], holes: Mapping[str, Ints]
) -> None:
    begin = min(float(score.pairs.stamps.min()) for score in paths.values())
    for name, score in paths.items():
        errors = np.column_stack((score.pairs.stamps - begin, position_errors(score.pairs)))
        axes.plot(*np.insert(errors, holes[name], np.nan, axis=0).T, **styles[name])
    axes.set(xlabel="time in s", ylabel="distance from the truth in m", xmargin=0.01)
    typical = [score.aligned.median for score in paths.values()]
    if max(typical) > LOG_RATIO * min(typical) > 0.0:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=max(0.1 * min(typical), 1e-4))
    else:
        axes.set_ylim(bottom=0.0)


def _draw_relations(
    axes: Axes, relations: Mapping[str, RelationErrors], styles: Mapping[str, Any]
) -> None:
    """Draw the cumulative distribution of relation errors."""
    largest = max(errors.metres.max for errors in relations.values())
    for name, errors in relations.items():
        axes.ecdf(np.maximum(errors.translation, MIN_ERROR), **styles[name])
    # Errors with closed and with missed loops differ by orders of magnitude.
    axes.set(xscale="log", xlabel="translation error in m", ylabel="share of the relations")
    axes.set_xlim(MIN_ERROR, max(10.0 * MIN_ERROR, 1.1 * largest))
    axes.set_ylim(0.0, 1.0)
    axes.xaxis.set_major_formatter("{x:g}")


def _holes(run: Array, score: PathScore) -> Ints:
    """Return the indices (k,) of pairs that follow poses of the run (n, 4) without truth."""
    rows = np.flatnonzero(np.isin(run[:, 0], score.pairs.stamps))
    return np.flatnonzero(np.diff(rows) > 1) + 1
