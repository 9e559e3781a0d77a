"""Plot of a sweep: the error of every run by setting, with median and interval.

Importing this module imports matplotlib (0.4 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from impslam.evaluation.colours import INK, PALE
from impslam.evaluation.comparison_plot import COLOURS, LOG_RATIO
from impslam.evaluation.plots import new_figure, quiet, shortened
from impslam.sweeps.rows import Row
from impslam.sweeps.statistics import Quantiles
from impslam.sweeps.verdict import MEASURES, by_log, log_names, measure_of, values_of

MIN_INTERVAL_RUNS = 5
"""Runs needed to draw an interval: fewer are visible as points."""


def draw_sweep(rows: Sequence[Row]) -> Figure:
    """Return the figure of runs; failed ones are left out."""
    logs = {log: some for log, some in by_log(rows).items() if measure_of(some)}
    names = list(dict.fromkeys(name for variants in logs.values() for name in variants))
    figure = new_figure(min(16.0, max(6.0, 2.5 + 0.9 * len(names))), 4.5, dpi=150)
    axes: Axes = figure.subplots()
    for k, (log, variants) in enumerate(zip(log_names(logs), logs.values(), strict=True)):
        measure, shift = measure_of(variants), 0.6 * ((k + 0.5) / len(logs) - 0.5)
        colour = COLOURS[k % len(COLOURS)]
        axes.plot([], [], "o", color=colour, label=f"{shortened(log)}: {MEASURES[measure]}")
        for name, some in variants.items():
            _draw_runs(axes, names.index(name) + shift, values_of(some, measure), colour)
    _label(axes, names)
    _scale(axes)
    done = sum(not row["error"] for row in rows)
    title = f"{done} runs; bar: median, line: 95 % of the runs"
    axes.set_title(title, color=PALE, fontsize=9, loc="left")
    if logs:
        figure.legend(loc="outside upper center", ncols=min(3, len(logs)), frameon=False)
    return figure


def _draw_runs(axes: Axes, x: float, values: Sequence[float], colour: str) -> None:
    """Draw the errors of one variant's runs of a log."""
    if not values:
        return
    axes.plot([x] * len(values), values, "o", ms=3.5, mew=0, color=colour, alpha=0.45)
    median, low, high = Quantiles.of(values)
    axes.plot([x - 0.08, x + 0.08], [median, median], color=colour, lw=2.2)
    if len(values) >= MIN_INTERVAL_RUNS:
        axes.plot([x, x], [low, high], color=colour, lw=1.0)


def _scale(axes: Axes) -> None:
    """Use a scale from 0, or a logarithmic one if small errors would be invisible."""
    values = np.concatenate([np.zeros(0), *(line.get_ydata() for line in axes.get_lines())])
    if len(values) and values.max() > LOG_RATIO * values.min() > 0.0:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)
    if len(values) and values.max() < 1.0:
        axes.yaxis.set_major_formatter(lambda y, _: f"{100.0 * y:g}")
        axes.set_ylabel("error in cm", color=INK)


def _label(axes: Axes, names: Sequence[str]) -> None:
    is_rotated = len(names) > 8 or max(map(len, names), default=0) > 16
    options: dict[str, Any] = {"rotation": 25, "ha": "right"} if is_rotated else {}
    axes.set_xticks(range(len(names)), [shortened(name) for name in names], **options)
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_ylabel("error in m", color=INK)
    quiet(axes)
