"""The picture of a consistency study: NEES against its band, errors beside the batch optimum's.

Importing this module imports matplotlib (0.3 s); import it where a picture is drawn.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from impslam.evaluation.consistency import chi2_bounds
from impslam.evaluation.consistency_study import BATCH, Curves, Study
from impslam.types import Array

COLOURS = ("#d81b60", "#2563eb", "#15803d", "#f2a03d", "#7c3aed", "#0891b2")
INK, PALE = "#37424d", "#e5e7ea"


def draw_study(study: Study) -> Figure:
    """Return a figure of three panels over the steps; save it with `figure.savefig(path)`."""
    figure = Figure(figsize=(8.0, 9.0), layout="constrained")
    FigureCanvasAgg(figure)
    nees, position, heading = figure.subplots(3, 1, sharex=True)
    nees.axhspan(*chi2_bounds(3, study.runs), color=PALE, label="95 % of a consistent filter's")
    colours = iter(COLOURS * len(study.curves))
    for name, curves in study.curves.items():
        colour = INK if name == BATCH else next(colours)
        for axes, values in zip((nees, position, heading), _shown(curves), strict=True):
            _line(axes, name, values, colour)
    nees.set_ylabel(f"pose NEES, mean of {study.runs} runs")
    nees.set_ylim(0.0, 10.0)
    position.set_ylabel("position RMSE [m]")
    heading.set_ylabel("heading RMSE [deg]")
    heading.set_xlabel("step")
    nees.legend(loc="upper left", ncols=2, frameon=False, fontsize="small")
    for axes in (nees, position, heading):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _shown(curves: Curves) -> tuple[Array, Array, Array]:
    return curves.nees, curves.position, np.degrees(curves.heading)


def _line(axes: Axes, name: str, values: Array, colour: str) -> None:
    """Draw a curve, or dots where it is known at check points only."""
    steps = np.flatnonzero(np.isfinite(values))
    style = "o" if name == BATCH else "-"
    axes.plot(steps, values[steps], style, color=colour, label=name, markersize=4, linewidth=1.2)
