"""The figures of the controlled experiments (thesis Fig. 24 to 26): one drive, mapped in several ways.

Importing this module imports matplotlib (0.3 s); import it where a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse

from impslam.evaluation.colours import INK, ODOMETRY, PATH, POINT, SIGMAS, TRUTH, WALL
from impslam.evaluation.plots import TIGHT, as_png, style
from impslam.studies.arena_runs import ArenaRun, true_landmarks
from impslam.types import Landmark

GROUND = "#c9ced4"
ENLARGED = 10.0
"""Ellipses are drawn so much larger: 3 sigma are a centimetre or two, less than a line's width."""
MARGIN = 0.45  # m of what is shown round the walls


def arena_png(runs: Mapping[str, ArenaRun], dpi: int = 130) -> bytes:
    """Return a PNG with a panel for each way of mapping, by its title."""
    figure = Figure(figsize=(3.1 * len(runs) + 0.4, 8.4), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(runs), sharey=True, squeeze=False)[0]
    for axes, (title, run) in zip(panels, runs.items(), strict=True):
        _draw(axes, run)
        axes.set_title(f"{title}\nend {run.end:.3f} m off", color=INK, fontsize=11)
        axes.label_outer()
    figure.legend(handles=_keys(), loc="outside lower center", ncols=4, frameon=False)
    return as_png(figure, **TIGHT)


def _draw(axes: Any, run: ArenaRun) -> None:
    _draw_truth(axes)
    axes.plot(*run.odometry[:, :2].T, color=ODOMETRY, lw=1.1, zorder=2)
    axes.plot(*run.path[:, :2].T, color=PATH, lw=1.6, zorder=4)
    axes.plot(*run.truth[:, :2].T, color=TRUTH, lw=1.1, ls=(0, (5, 3)), zorder=5)
    for mark in run.landmarks:
        _draw_landmark(axes, mark)
    look: dict[str, Any] = {"mec": "white", "mew": 1.0, "zorder": 8, "ls": ""}
    axes.plot(*run.truth[0, :2], marker="o", ms=8, mfc=TRUTH, **look)
    axes.plot(*run.path[-1, :2], marker="s", ms=7, mfc=INK, **look)
    style(axes)


def _draw_truth(axes: Any) -> None:
    """Draw walls and cylinders as they are, and show what is round them."""
    ends = np.vstack([mark.end_points for mark in true_landmarks() if mark.end_points is not None])
    (left, bottom), (right, top) = ends.min(axis=0) - MARGIN, ends.max(axis=0) + MARGIN
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    for mark in true_landmarks():
        if mark.end_points is not None:
            axes.plot(*mark.end_points.T, color=GROUND, lw=7, solid_capstyle="round", zorder=0)
        elif mark.kind == "cylinder":
            radius = mark.parameters["radius"]
            axes.add_patch(Circle(tuple(mark.position), radius, fc=GROUND, ec="none", zorder=0))


def _draw_landmark(axes: Any, mark: Landmark) -> None:
    if mark.end_points is not None:
        axes.plot(*mark.end_points.T, color=WALL, lw=1.6, marker="|", ms=0, zorder=3)
        axes.plot(*mark.end_points.T, "o", ms=4, mfc="white", mec=WALL, mew=1.2, zorder=6)
        return
    values, vectors = np.linalg.eigh(mark.covariance)
    size = 2.0 * SIGMAS * ENLARGED * np.sqrt(np.maximum(values, 0.0))
    turn = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    place = (float(mark.position[0]), float(mark.position[1]))
    axes.add_patch(Ellipse(place, size[1], size[0], angle=turn, fill=False, ec=POINT, zorder=6))
    axes.plot(*place, marker="+", ms=7, mew=1.3, color=POINT, zorder=7)


def _keys() -> list[Any]:
    dot: dict[str, Any] = {"ls": "", "mec": "white"}
    ring: dict[str, Any] = {"marker": "o", "mfc": "white", "mec": WALL, "ms": 5}
    return [
        Line2D([], [], color=TRUTH, lw=1.5, ls=(0, (5, 3)), label="truth"),
        Line2D([], [], color=ODOMETRY, lw=1.5, label="odometry alone"),
        Line2D([], [], color=PATH, lw=2, label="SLAM"),
        Line2D([], [], color=GROUND, lw=6, label="what is there"),
        Line2D([], [], color=WALL, lw=1.6, **ring, label="wall, its ends"),
        Line2D([], [], color=POINT, ls="", marker="+", ms=8, label="point, 3σ ellipse ×10"),
        Line2D([], [], marker="o", ms=8, mfc=TRUTH, label="start", **dot),
        Line2D([], [], marker="s", ms=7, mfc=INK, label="end", **dot),
    ]
