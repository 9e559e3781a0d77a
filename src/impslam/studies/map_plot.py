"""Plot maps side by side: truth, odometry, estimated path and landmarks of several runs.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse

from impslam.evaluation.colours import INK, ODOMETRY, PATH, POINT, SIGMAS, TRUTH, WALL
from impslam.evaluation.plots import TIGHT, as_png, new_figure, style
from impslam.simulation.scene import Scene
from impslam.studies.sweep import StudyRun
from impslam.types import Array, Landmark

ELLIPSE_SCALE = 10.0
"""Enlargement of ellipses: 3 sigma are a centimetre or two, less than a line's width."""
GROUND, WALKERS, FALSE = "#bec5cd", "#0e9aa7", "#111827"


@dataclass(frozen=True, slots=True)
class PlotLayout:
    """Layout of a map plot.

    Attributes
    ----------
    limits : left, right, bottom, top of the visible area, m
    size : width and height of a panel, in
    wide : whether panels are stacked vertically
    ground : line width of the true walls, pt
    detailed : whether ends of walls and ellipses of points are drawn
    dpi : resolution
    """

    limits: tuple[float, float, float, float]
    size: tuple[float, float]
    wide: bool
    ground: float
    detailed: bool
    dpi: int


ARENA = PlotLayout((-2.13, 0.76, -0.76, 6.55), (3.1, 7.7), False, 7.0, True, 130)
CORRIDOR = PlotLayout((-9.0, 57.0, -10.0, 21.0), (9.6, 4.5), True, 3.2, False, 110)


def draw_maps(
    runs: Mapping[str, StudyRun],
    layout: PlotLayout,
    false: Mapping[str, Collection[int]] | None = None,
) -> bytes:
    """Return a PNG with a panel for each run, by its title.

    `false` are the ids of landmarks to draw as false, by the run's title.
    """
    count = len(runs)
    shape = (count, 1) if layout.wide else (1, count)
    width, height = layout.size
    figure = new_figure(
        width * shape[1] + 0.4 * (not layout.wide), height * shape[0] + 0.7, dpi=layout.dpi
    )
    panels = figure.subplots(*shape, sharex=layout.wide, sharey=not layout.wide, squeeze=False)
    for axes, (title, run) in zip(panels.flat, runs.items(), strict=True):
        _draw(axes, run, layout, (false or {}).get(title, ()))
        axes.set_title(title, color=INK, fontsize=11)
        axes.label_outer()
    people = any(run.world.people for run in runs.values())
    keys = _keys(people, any((false or {}).values()), layout.detailed)
    columns = 5 if layout.wide else 4
    figure.legend(handles=keys, loc="outside lower center", ncols=columns, frameon=False)
    return as_png(figure, **TIGHT)


def _draw(axes: Any, run: StudyRun, layout: PlotLayout, false: Collection[int]) -> None:
    left, right, bottom, top = layout.limits
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    scene = Scene(run.world)
    draw_scene(axes, scene, scene.leaves(0.0), layout.ground)
    for person in run.world.people:
        axes.plot(*np.array(person.waypoints).T, color=WALKERS, lw=0.9, ls=(0, (1, 1.5)), zorder=1)
    axes.plot(*run.odometry[:, :2].T, color=ODOMETRY, lw=1.1, zorder=2)
    axes.plot(*run.path[:, :2].T, color=PATH, lw=1.5, zorder=5)
    axes.plot(*run.truth[:, :2].T, color=TRUTH, lw=1.1, ls=(0, (5, 3)), zorder=6)
    for mark in run.landmarks:
        _draw_landmark(axes, mark, mark.id in false, layout.detailed)
    dot: dict[str, Any] = {"mec": "white", "mew": 1.0, "zorder": 8, "ls": ""}
    axes.plot(*run.truth[0, :2], marker="o", ms=8, mfc=TRUTH, **dot)
    axes.plot(*run.path[-1, :2], marker="s", ms=7, mfc=INK, **dot)
    if _leaves(run.path[:, :2], layout.limits):
        box = {"fc": "white", "ec": "none", "alpha": 0.85}
        corner, text = (right - 0.3, bottom + 0.1), "the estimate leaves the picture"
        axes.annotate(text, corner, ha="right", color=PATH, fontsize=9, bbox=box, zorder=9)
    style(axes)


def _leaves(points: Array, limits: tuple[float, float, float, float]) -> bool:
    """Return whether any of the points (n, 2) is outside the limits."""
    low, high = np.reshape(limits, (2, 2)).T
    return bool(((points < low) | (points > high)).any())


def draw_scene(axes: Any, scene: Scene, leaves: Array, width: float) -> None:
    """Draw the static scene and the leaves (k, 4) m of doors; `width` is in pt."""
    rows = np.vstack([scene.segments, leaves]).reshape(-1, 2, 2)
    options: dict[str, Any] = {"capstyle": "round", "zorder": 1}
    axes.add_collection(LineCollection(list(rows), colors=GROUND, linewidths=width, **options))
    for x, y, radius in scene.circles.tolist():
        axes.add_patch(Circle((x, y), radius, fc=GROUND, ec=GROUND, lw=1.5, zorder=1))


def _draw_landmark(axes: Any, mark: Landmark, false: bool, detailed: bool) -> None:
    if mark.end_points is not None:
        colour = FALSE if false else WALL
        axes.plot(*mark.end_points.T, color=colour, lw=1.4, zorder=3)
        if detailed:
            axes.plot(*mark.end_points.T, "o", ms=4, mfc="white", mec=colour, mew=1.2, zorder=6)
        return
    colour = FALSE if false else POINT
    axes.plot(*mark.position, marker="+", ms=6, mew=1.2, color=colour, zorder=7)
    if detailed:
        values, vectors = np.linalg.eigh(mark.covariance)
        size = 2.0 * SIGMAS * ELLIPSE_SCALE * np.sqrt(np.maximum(values, 0.0))
        turn = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        centre = (float(mark.position[0]), float(mark.position[1]))
        shape: dict[str, Any] = {"angle": turn, "fill": False, "ec": colour, "zorder": 6}
        axes.add_patch(Ellipse(centre, size[1], size[0], **shape))


def _keys(people: bool, false: bool, detailed: bool) -> list[Any]:
    """Return the legend's entries."""
    dot: dict[str, Any] = {"ls": "", "mec": "white"}
    ends: dict[str, Any] = {"marker": "o", "ms": 5, "mfc": "white", "label": "wall, its ends"}
    point = f"point, 3σ ellipse ×{ELLIPSE_SCALE:g}" if detailed else "corner, cylinder"
    walkers = Line2D([], [], color=WALKERS, lw=1.2, ls=(0, (1, 1.5)), label="people's ways")
    return [
        Line2D([], [], color=TRUTH, lw=1.5, ls=(0, (5, 3)), label="truth"),
        Line2D([], [], color=ODOMETRY, lw=1.5, label="odometry alone"),
        Line2D([], [], color=PATH, lw=2, label="SLAM"),
        *([walkers] if people else []),
        Line2D([], [], color=GROUND, lw=4, label="what is there"),
        Line2D([], [], color=WALL, lw=1.6, **(ends if detailed else {"label": "wall"})),
        Line2D([], [], color=POINT, ls="", marker="+", ms=8, label=point),
        *([Line2D([], [], color=FALSE, lw=1.6, label="false landmark")] if false else []),
        Line2D([], [], marker="o", ms=8, mfc=TRUTH, label="start", **dot),
        Line2D([], [], marker="s", ms=7, mfc=INK, label="estimated end", **dot),
    ]
