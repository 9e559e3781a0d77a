"""Plot of a search: the score by trial, and over each parameter.

Importing this module imports matplotlib (0.4 s); import it only to draw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from impslam.evaluation.colours import INK, PALE, PATH, WALL
from impslam.evaluation.plots import new_figure, quiet

COLUMNS = 3
"""Panels side by side."""


def draw_search(study: Any, keys: Sequence[str]) -> Figure:
    """Return the figure of a study's trials; failed ones are left out."""
    trials = [trial for trial in study.trials if trial.values]
    rows = math.ceil((1 + len(keys)) / COLUMNS)
    figure = new_figure(3.4 * min(COLUMNS, 1 + len(keys)), 0.3 + 2.7 * rows, dpi=150)
    panels: list[Axes] = list(
        figure.subplots(rows, min(COLUMNS, 1 + len(keys)), squeeze=False).flat
    )
    scores = np.array([trial.value for trial in trials])
    best = int(np.argmin(scores))
    for panel in panels[1 + len(keys) :]:
        panel.set_axis_off()
    numbers = [trial.number for trial in trials]
    panels[0].plot(numbers, np.minimum.accumulate(scores), color=WALL, lw=1.2)
    _draw(panels[0], numbers, scores, best)
    panels[0].set_xlabel("trial")
    for panel, key in zip(panels[1:], keys, strict=False):
        values = [trial.params[key] for trial in trials]
        _draw(panel, values, scores, best)
        panel.set_xlabel(key, fontsize=9)
        if all(isinstance(v, int | float) and v > 0.0 for v in values):
            panel.set_xscale("log")
    top = np.quantile(scores, 0.9)
    for panel in panels[: 1 + len(keys)]:
        quiet(panel)
        panel.set_ylim(top=top + 0.1 * (top - scores[best]) or None)
    panels[0].set_ylabel("score (lower is better)", color=INK)
    title = (
        f"{len(trials)} trials, the worst tenth left out; red: the best; trial 0: the config itself"
    )
    figure.suptitle(title, color=PALE, fontsize=9)
    return figure


def _draw(panel: Axes, values: Sequence[Any], scores: np.ndarray, best: int) -> None:
    panel.plot(values, scores, "o", ms=3.5, mew=0, color=WALL, alpha=0.5)
    panel.plot(values[best], scores[best], "o", ms=6, mew=0, color=PATH)
