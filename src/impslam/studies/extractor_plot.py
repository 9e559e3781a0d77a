"""Figure of the comparison of extractors.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from impslam.evaluation.colours import INK
from impslam.evaluation.plots import as_png, new_figure
from impslam.studies.extractor_stats import ExtractorScore, typical_ratio
from impslam.studies.extractor_tables import OTHER, Scores

COLOURS = ("#2563eb", "#d81b60", "#15803d", "#f2a03d", "#7c3aed", "#0891b2", "#8d6e63")
GRID = "#e5e7ea"
EDGES = {"wall": (10, 20, 40, 80, 160, 320, 683), "cylinder": (5, 8, 12, 20, 35, 60, 100)}
MIN_BIN_COUNT = 8  # landmarks in a bin that is drawn
DRAWS = 300  # bootstrap samples behind an error bar


def draw(scores: Mapping[str, Scores], conditions: Sequence[str], known: str) -> bytes:
    """Return the picture as a PNG.

    `conditions` are the names of the conditions without faults, without people and with people; `known` is
    the label of the fit with known association.
    """
    figure = new_figure(9.0, 8.6, dpi=130)
    rows = figure.subplots(3, 2, gridspec_kw={"height_ratios": (5, 2.6, 2.6)})
    for (ratio, share, false), (kind, one) in zip(rows.T, scores.items(), strict=True):
        labels = sorted(one, key=lambda label: label == known)
        colours = dict(zip(labels, [*COLOURS[: len(labels) - 1], INK], strict=True))
        _ratios(ratio, kind, {label: one[label][conditions[0]] for label in labels}, colours)
        some = {label: one[label] for label in labels if label != known}
        _shares(share, some, conditions[1:], colours)
        _spurious(false, some, conditions[1:], colours)
        false.set_xlabel(f"per scan: false (filled), {OTHER[kind]} (outlined)")
    rows[0, 0].set_ylabel("typical error ÷ Cramér-Rao bound\n(robot standing, range noise alone)")
    return as_png(figure)


def _ratios(
    axes: Axes, kind: str, scores: Mapping[str, ExtractorScore], colours: Mapping[str, str]
) -> None:
    """Draw the ratio to the bound over the number of beams that hit the landmark."""
    edges = np.array(EDGES[kind])
    axes.axhline(1.0, color=INK, lw=0.8)
    for number, (label, score) in enumerate(scores.items()):
        shift = 1.0 + 0.025 * (number - 0.5 * len(scores))
        points = [_point(score, low, high) for low, high in pairwise(edges.tolist())]
        drawn = np.array([(x * shift, y, a, b) for x, y, a, b in points if np.isfinite(y)]).reshape(
            -1, 4
        )
        x, y, below, above = drawn.T
        options: dict[str, Any] = {
            "color": colours[label],
            "label": label,
            "lw": 1.3,
            "ms": 4,
            "capsize": 2,
        }
        axes.errorbar(x, y, (y - below, above - y), marker="o", **options)
    axes.set(xscale="log", yscale="log", xlabel="beams that hit it", title=f"{kind}s".capitalize())
    axes.xaxis.set_major_locator(FixedLocator(edges.tolist()))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:.0f}")
    axes.yaxis.set_major_locator(FixedLocator([0.5, 1, 2, 5, 10, 20, 50, 100, 200]))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(frameon=False, fontsize=8)
    _style(axes)


def _point(score: ExtractorScore, low: float, high: float) -> tuple[float, float, float, float]:
    """Return middle, ratio and its 95 % interval of the landmarks in a bin of beams."""
    excess = score.excess[(score.beams >= low) & (score.beams < high)]
    if len(excess) < MIN_BIN_COUNT:
        return np.nan, np.nan, np.nan, np.nan
    rng = np.random.default_rng(0)
    again = [typical_ratio(rng.choice(excess, len(excess))) for _ in range(DRAWS)]
    below, above = np.percentile(again, (2.5, 97.5))
    middle = typical_ratio(excess)
    return float(np.sqrt(low * high)), middle, min(below, middle), max(above, middle)


def _shares(
    axes: Axes, scores: Scores, conditions: Sequence[str], colours: Mapping[str, str]
) -> None:
    """Draw the shares of found landmarks, without and with people."""
    for height, shade, score, colour in _bars(axes, scores, conditions, colours):
        share, error = score.true_positives
        axes.barh(height, 100.0 * share, 0.38, color=colour, alpha=shade)
        axes.errorbar(100.0 * share, height, xerr=200.0 * error, fmt="none", ecolor=INK, lw=0.9)
    axes.set(xlim=(0.0, 100.0), xlabel="found, % of the visible; with people (light)")


def _spurious(
    axes: Axes, scores: Scores, conditions: Sequence[str], colours: Mapping[str, str]
) -> None:
    """Draw the numbers of observations per scan that are false, or of other things."""
    for height, shade, score, colour in _bars(axes, scores, conditions, colours):
        false, error = score.rate("false")
        other, _ = score.rate("other")
        axes.barh(height, false, 0.38, color=colour, alpha=shade)
        axes.barh(height, other, 0.34, left=false, fill=False, ec=colour, alpha=shade, lw=1.2)
        axes.errorbar(false, height, xerr=2.0 * error, fmt="none", ecolor=INK, lw=0.9)
    axes.set_xlim(0.0, None)


def _bars(
    axes: Axes, scores: Scores, conditions: Sequence[str], colours: Mapping[str, str]
) -> Iterator[tuple[float, float, ExtractorScore, str]]:
    """Yield height, shade, score and colour of each bar."""
    count = len(scores)
    axes.set_yticks(np.arange(count)[::-1], list(scores), fontsize=8)
    _style(axes)
    for number, (label, one) in enumerate(scores.items()):
        for shift, condition, shade in zip((0.2, -0.2), conditions, (1.0, 0.45), strict=True):
            yield count - 1 - number + shift, shade, one[condition], colours[label]


def _style(axes: Axes) -> None:
    axes.grid(color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
