"""The picture of a run: grid, paths and landmarks in one figure.

Importing this module imports matplotlib (0.3 s); import it where a picture is drawn. Figures are
drawn on their own canvas, without pyplot and its global state.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse

from impslam.mapping.files import FREE, OCCUPIED, MapImage
from impslam.types import Array, Landmark

INK, PALE = "#37424d", "#8a949e"
PATH, ODOMETRY, TRUTH, WALL, POINT = "#d81b60", "#f2a03d", "#15803d", "#2563eb", "#7c3aed"
UNKNOWN = "#eceef1"
GREYS = ListedColormap([UNKNOWN, "#ffffff", "#7d8892"])  # unknown, free, occupied
SIGMAS = 3.0
TIGHT: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.12}
"""How a picture is cut to what is drawn."""
MAX_POINTS = 4000
"""Points of a drawn path: more than the picture has pixels along it."""
MAX_LABELS = 40
"""Landmarks that are labelled; more would hide the map."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What is drawn; paths are (n, 2) m in map, empty where there is none."""

    image: MapImage
    path: Array
    odometry: Array
    truth: Array
    landmarks: Sequence[Landmark]


def map_png(scene: Scene, dpi: int = 160) -> bytes:
    """Return the map with paths and landmarks as a PNG."""
    left, right, bottom, top = _bounds(scene)
    width, height = right - left, top - bottom
    inches = np.array([width, height]) * (9.0 / max(width, 0.9 * height))
    figure = Figure(figsize=tuple(inches), dpi=dpi)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), facecolor=UNKNOWN)
    _draw_grid(axes, scene.image)
    thickness = float(np.clip(15.0 / max(width, height), 0.5, 1.0))
    _draw_paths(axes, scene, thickness)
    _draw_landmarks(axes, scene.landmarks, thickness)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    style(axes)
    keys = _keys(scene)
    columns = 3 if inches[0] < 7 else 4
    place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "frameon": False}
    axes.legend(handles=keys, ncols=columns, **place)
    return as_png(figure, **TIGHT)


def as_png(figure: Figure, **look: Any) -> bytes:
    """Return a figure as a PNG, the same bytes for the same picture; `look` is `savefig`'s."""
    stream = io.BytesIO()
    plain = {"Software": None}  # no version in the file
    figure.savefig(stream, format="png", metadata=plain, **look)
    return stream.getvalue()


def _bounds(scene: Scene) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of what SLAM and the truth show; odometry may run off."""
    left, right, bottom, top = scene.image.extent
    ends = [mark.end_points for mark in scene.landmarks if mark.end_points is not None]
    at = [mark.position[None] for mark in scene.landmarks if mark.end_points is None]
    points = np.vstack([scene.path, scene.truth, *ends, *at, [[left, bottom], [right, top]]])
    points = points[np.isfinite(points).all(axis=1)]
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * max(x1 - x0, y1 - y0, 1.0)
    return x0 - margin, x1 + margin, y0 - margin, y1 + margin


def _draw_grid(axes: Any, image: MapImage) -> None:
    classes = (image.pixels == FREE).astype(np.uint8) + 2 * (image.pixels == OCCUPIED)
    look = {"interpolation": "antialiased", "interpolation_stage": "rgba", "extent": image.extent}
    axes.imshow(classes, cmap=GREYS, vmin=0, vmax=2, zorder=0, **look)


def _draw_paths(axes: Any, scene: Scene, thickness: float) -> None:
    axes.plot(*_thin(scene.odometry).T, color=ODOMETRY, lw=1.2 * thickness, zorder=2)
    axes.plot(*_thin(scene.path).T, color=PATH, lw=1.8 * thickness, zorder=4)
    axes.plot(*_thin(scene.truth).T, color=TRUTH, lw=1.2, ls=(0, (5, 3)), zorder=5)
    if len(scene.path):
        look = {"mec": "white", "mew": 1.2, "zorder": 8, "ls": ""}
        axes.plot(*scene.path[0], marker="o", ms=9, mfc=TRUTH, **look)
        axes.plot(*scene.path[-1], marker="s", ms=8, mfc=INK, **look)


def _thin(path: Array) -> Array:
    """Return every k-th point of a path, and its last."""
    if len(path) <= MAX_POINTS:
        return path
    step = -(-len(path) // MAX_POINTS)
    return np.vstack((path[:-1:step], path[-1]))


def _draw_landmarks(axes: Any, landmarks: Sequence[Landmark], thickness: float) -> None:
    labelled = len(landmarks) <= MAX_LABELS
    walls = [mark.end_points for mark in landmarks if mark.end_points is not None]
    look: dict[str, Any] = {"capstyle": "round", "alpha": 0.75, "zorder": 3}
    # All at once: an artist for each takes 1 ms.
    axes.add_collection(LineCollection(walls, colors=WALL, linewidths=3.5 * thickness, **look))
    for mark in landmarks:
        place = mark.position if mark.end_points is None else mark.end_points.mean(axis=0)
        if mark.end_points is None:
            _draw_point(axes, mark)
        if labelled:
            box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.7}
            look = {"ha": "left", "va": "bottom", "fontsize": 7.5, "color": INK, "bbox": box}
            axes.annotate(str(mark.id), place, (4, 4), textcoords="offset points", zorder=7, **look)


def _draw_point(axes: Any, mark: Landmark) -> None:
    x, y = (float(v) for v in mark.position)
    radius = mark.parameters.get("radius", 0.05)
    axes.add_patch(Circle((x, y), radius, fc=POINT, ec=POINT, alpha=0.35, zorder=5))
    axes.plot(x, y, marker="+", ms=5, mew=1.0, color=POINT, zorder=6)
    values, vectors = np.linalg.eigh(mark.covariance)
    size = 2.0 * SIGMAS * np.sqrt(np.maximum(values, 0.0))
    turn = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    ellipse = Ellipse((x, y), size[1], size[0], angle=turn, fill=False, ec=POINT, lw=1.1, zorder=6)
    axes.add_patch(ellipse)


def style(axes: Any) -> None:
    """Give axes of a map their labels and quiet colours."""
    axes.set_xlabel("x in m", color=INK)
    axes.set_ylabel("y in m", color=INK)
    axes.tick_params(colors=PALE, labelcolor=INK, labelsize=9)
    axes.grid(color="#000000", alpha=0.06, lw=0.6)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#d4d9de")


def _keys(scene: Scene) -> list[Any]:
    """Return the legend's entries for what is there."""
    kinds = {mark.end_points is None for mark in scene.landmarks}
    dot: dict[str, Any] = {"ls": "", "mec": "white"}
    entries = [
        (True, Line2D([], [], color=PATH, lw=2, label="SLAM")),
        (True, Line2D([], [], color=ODOMETRY, lw=1.5, label="odometry alone")),
        (
            len(scene.truth) > 0,
            Line2D([], [], color=TRUTH, lw=1.5, ls=(0, (5, 3)), label="truth"),
        ),
        (False in kinds, Line2D([], [], color=WALL, lw=3.5, alpha=0.75, label="wall")),
        (
            True in kinds,
            Line2D([], [], color=POINT, ls="", marker="o", mfc="none", label="point, 3σ ellipse"),
        ),
        (True, Line2D([], [], marker="o", ms=9, mfc=TRUTH, label="start", **dot)),
        (True, Line2D([], [], marker="s", ms=8, mfc=INK, label="end", **dot)),
    ]
    return [handle for there, handle in entries if there]
