"""Figures of consistency: NEES with its band, and errors compared with the batch optimum.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from impslam.evaluation.colours import INK
from impslam.evaluation.consistency import chi2_bounds
from impslam.evaluation.plots import new_figure
from impslam.studies.consistency_arena import ArenaConsistency
from impslam.studies.filter_consistency import BATCH, Curves, FilterStudy
from impslam.types import Array

COLOURS = ("#d81b60", "#e08a00", "#2563eb", "#15803d", "#7c3aed", "#0891b2")
BAND = "#dfe3e8"
IDEAL = 3.0  # the pose's degrees of freedom


def draw_study(study: FilterStudy) -> Figure:
    """Return a figure of NEES and RMSE over the steps; save it with `figure.savefig(path)`."""
    figure, (nees, position, heading) = _panels(7.6, (2.0, 1.2, 1.2))
    _band(nees, study.runs)
    colours = iter(COLOURS * len(study.curves))
    for name, curves in study.curves.items():
        colour = INK if name == BATCH else next(colours)
        for axes, values in zip((nees, position, heading), _shown(curves), strict=True):
            _line(axes, name, values, colour)
    _finish_nees(nees, f"pose NEES\nmean of {study.runs} runs")
    position.set_ylabel("position\nRMSE [m]")
    heading.set_ylabel("heading\nRMSE [deg]")
    heading.set_xlabel("step")
    heading.set_xlim(0, study.setting.steps)
    for axes in (position, heading):
        axes.set_ylim(bottom=0.0)
    return figure


def draw_arena(results: Sequence[ArenaConsistency]) -> Figure:
    """Return a figure of NEES by time: a panel for each case, a curve for each filter."""
    cases = list(dict.fromkeys(result.case for result in results))
    figure, panels = _panels(1.0 + 2.0 * len(cases), (1.0,) * len(cases))
    names = dict.fromkeys(result.filter for result in results)
    colours = dict(zip(names, COLOURS[::3] * len(names), strict=False))
    for axes, case in zip(panels, cases, strict=True):
        shown = [result for result in results if result.case == case]
        _band(axes, shown[0].runs)
        for result in shown:
            axes.plot(result.times, result.nees, "-", color=colours[result.filter], lw=1.1)
            axes.lines[-1].set_label(result.filter)
        axes.set_title(f"{case} ({shown[0].runs} runs)", fontsize="medium", loc="left")
        axes.set_ylabel("pose NEES")
        axes.set_ylim(0.0, 8.0)
        legend = axes.legend(loc="lower right", ncols=3, frameon=False, fontsize="small")
        legend.set_bbox_to_anchor((1.0, 0.95), axes.transAxes)
    panels[-1].set_xlim(results[0].times[0], results[0].times[-1])
    panels[-1].set_xlabel("time [s]")
    return figure


def _panels(height: float, ratios: tuple[float, ...]) -> tuple[Figure, list[Axes]]:
    """Return a figure and its panels, one below the other."""
    figure = new_figure(8.0, height)
    grid = figure.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)
    panels: list[Axes] = list(grid[:, 0])
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _band(axes: Axes, runs: int) -> None:
    """Draw the interval of a consistent filter's mean."""
    axes.axhspan(*chi2_bounds(3, runs), color=BAND, lw=0, label="consistent, 95 %")
    axes.axhline(IDEAL, color="white", lw=1.0)


def _finish_nees(axes: Axes, label: str) -> None:
    """Label the axis, logarithmic for very overconfident filters, with room for the legend."""
    drawn = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.lines]
    highest = max(float(np.max(values, initial=IDEAL)) for values in drawn)
    axes.set_yscale("log")
    axes.set_ylim(1.0, 2.0 * highest)
    axes.set_yticks([n for n in (1, 2, 3, 5, 10, 20, 50, 100, 200, 500) if n < 2.0 * highest])
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel(label)
    axes.legend(loc="upper left", ncols=6, frameon=False, fontsize="small")


def _shown(curves: Curves) -> tuple[Array, Array, Array]:
    return curves.nees, curves.position, np.degrees(curves.heading)


def _line(axes: Axes, name: str, values: Array, colour: str) -> None:
    """Draw a curve, or dots if it is known at check points only."""
    steps = np.flatnonzero(np.isfinite(values))
    style = "o" if name == BATCH else "-"
    axes.plot(steps, values[steps], style, color=colour, label=name, markersize=4, linewidth=1.2)
