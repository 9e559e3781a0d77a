"""The figures of the corridor (thesis Fig. 29): one drive, mapped in several ways, one above the other.

Importing this module imports matplotlib (0.3 s); import it where a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from impslam.evaluation.colours import INK, ODOMETRY, PATH, POINT, TRUTH, WALL
from impslam.evaluation.plots import TIGHT, as_png, style
from impslam.studies.corridor_runs import CorridorRun, corridor_truth
from impslam.types import Array, Landmark

GROUND, WALKERS = "#b4bcc5", "#0e9aa7"
FALSE = "#111827"
LEAVES = "the estimate leaves the picture"
LIMITS = (-9.0, 57.0, -10.0, 21.0)
"""m: left, right, bottom, top of what is shown; what leaves it is cut off, and said so."""


def corridor_png(runs: Mapping[str, CorridorRun], dpi: int = 110) -> bytes:
    """Return a PNG with a panel for each way of mapping, by its title."""
    figure = Figure(figsize=(9.6, 4.5 * len(runs) + 0.7), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (title, run) in zip(panels, runs.items(), strict=True):
        _draw(axes, run)
        far = 100.0 * run.end / run.way
        axes.set_title(
            f"{title}: ends {run.end:.2f} m off, {far:.2f} % of {run.way:.0f} m",
            color=INK,
            fontsize=11,
        )
        axes.label_outer()
    figure.legend(handles=_keys(), loc="outside lower center", ncols=5, frameon=False)
    return as_png(figure, **TIGHT)


def _draw(axes: Any, run: CorridorRun) -> None:
    left, right, bottom, top = LIMITS
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    _draw_truth(axes)
    axes.plot(*run.odometry[:, :2].T, color=ODOMETRY, lw=1.1, zorder=2)
    axes.plot(*run.path[:, :2].T, color=PATH, lw=1.4, zorder=5)
    axes.plot(*run.truth[:, :2].T, color=TRUTH, lw=1.1, ls=(0, (5, 3)), zorder=6)
    for mark in run.landmarks:
        _draw_landmark(axes, mark, mark.id in run.false)
    look: dict[str, Any] = {"mec": "white", "mew": 1.0, "zorder": 8, "ls": ""}
    axes.plot(*run.truth[0, :2], marker="o", ms=8, mfc=TRUTH, **look)
    axes.plot(*run.path[-1, :2], marker="s", ms=7, mfc=INK, **look)
    if _outside(run.path[:, :2]):
        said = {"ha": "right", "fontsize": 9, "bbox": {"fc": "white", "ec": "none", "alpha": 0.85}}
        axes.text(right - 1.0, bottom + 1.0, LEAVES, color=PATH, zorder=9, **said)
    style(axes)


def _outside(points: Array) -> bool:
    left, right, bottom, top = LIMITS
    x, y = points.T
    return bool(((x < left) | (x > right) | (y < bottom) | (y > top)).any())


def _draw_truth(axes: Any) -> None:
    """Draw what stands, the doors as they are at the beginning, and where people walk."""
    scene = corridor_truth().scene
    rows = np.vstack([scene.segments, scene.leaves(0.0)]).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(rows), colors=GROUND, linewidths=3.2, zorder=0))
    for x, y, radius in scene.circles.tolist():
        axes.add_patch(Circle((x, y), radius, fc=GROUND, ec=GROUND, lw=1.5, zorder=0))
    for person in scene.world.people:
        way = np.array(person.waypoints)
        axes.plot(*way.T, color=WALKERS, lw=0.9, ls=(0, (1, 1.5)), zorder=1)


def _draw_landmark(axes: Any, mark: Landmark, false: bool) -> None:
    colour = FALSE if false else (WALL if mark.end_points is not None else POINT)
    if mark.end_points is not None:
        axes.plot(*mark.end_points.T, color=colour, lw=1.3, zorder=3)
        return
    axes.plot(*mark.position, marker="+", ms=5, mew=1.1, color=colour, zorder=7)


def _keys() -> list[Any]:
    dot: dict[str, Any] = {"ls": "", "mec": "white"}
    return [
        Line2D([], [], color=TRUTH, lw=1.5, ls=(0, (5, 3)), label="truth"),
        Line2D([], [], color=ODOMETRY, lw=1.5, label="odometry alone"),
        Line2D([], [], color=PATH, lw=2, label="SLAM"),
        Line2D([], [], color=WALKERS, lw=1.2, ls=(0, (1, 1.5)), label="people's ways"),
        Line2D([], [], color=GROUND, lw=4, label="what is there"),
        Line2D([], [], color=WALL, lw=1.6, label="wall"),
        Line2D([], [], color=POINT, ls="", marker="+", ms=8, label="corner, cylinder"),
        Line2D([], [], color=FALSE, lw=1.6, label="false landmark"),
        Line2D([], [], marker="o", ms=8, mfc=TRUTH, label="start", **dot),
        Line2D([], [], marker="s", ms=7, mfc=INK, label="estimated end", **dot),
    ]
