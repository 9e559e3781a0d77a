"""Figures of Chapter IV: scans from above.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon, Wedge

from impslam.evaluation.colours import INK
from impslam.evaluation.plots import new_figure, quiet
from impslam.extractors.readings import usable
from impslam.geometry.se2 import compose, transform
from impslam.simulation.camera import SceneCamera
from impslam.studies.chapter4_detections import ScanDetections
from impslam.studies.chapter4_scans import SceneSnapshot
from impslam.studies.map_plot import GROUND, draw_scene
from impslam.types import Array, Observation

TRUE, SPURIOUS = "#2563eb", "#d81b60"
LEG, FIELD = "#f2c38d", "#eef4fb"
READING = "#5b6671"
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 9, "columnspacing": 1.2}
WIDTH = 8.6  # in
MARGIN = 0.35  # m around the readings
PNG: dict[str, Any] = {"dpi": 150, "bbox_inches": "tight", "pad_inches": 0.1}
ROBOT = 0.25  # m, radius of the robot's outline


def scan_figure(detections: ScanDetections, radius: float = 0.0) -> Figure:
    """Draw a scan from above: the truth in pale colours, readings, true and spurious detections.

    `radius` (m) is that of the detected cylinders.
    """
    box = bounds(detections.snapshot)
    figure = new_figure(*_size(box, WIDTH, 7.4))
    draw_scan(figure.subplots(), detections, box, radius)
    add_legend(figure, detections, 4 if _is_wide(box) else 2)
    return figure


def people_figure(detections: ScanDetections) -> Figure:
    """Draw the true scene with people beside (or above) the detected walls (Figs. 18, 19)."""
    box = bounds(detections.snapshot)
    wide = _is_wide(box)
    width, height = _size(box, WIDTH if wide else WIDTH / 2, 6.4)
    figure = new_figure(width, 2 * height) if wide else new_figure(2 * width, height)
    panels = list(figure.subplots(2 if wide else 1, 1 if wide else 2, squeeze=False).flat)
    bare = ScanDetections(detections.snapshot, (), ())
    draw_scan(panels[0], bare, box, 0.0, readings=False)
    draw_scan(panels[1], detections, box, 0.0)
    for axes, title in zip(panels, ("(a) the scene", "(b) readings and walls found"), strict=True):
        axes.set_title(title, loc="left", color=INK, fontsize=10)
    add_legend(figure, detections, 4)
    return figure


def _is_wide(box: Sequence[float]) -> bool:
    return box[1] - box[0] > 1.5 * (box[3] - box[2])


def bounds(snapshot: SceneSnapshot) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top in map of the readings and the robot."""
    points = transform(snapshot.pose, snapshot.scan.points[usable(snapshot.scan)])
    points = np.vstack([points, snapshot.pose[:2] - ROBOT, snapshot.pose[:2] + ROBOT])
    (x0, y0), (x1, y1) = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    return float(x0), float(x1), float(y0), float(y1)


def _size(box: Sequence[float], width: float, tallest: float) -> tuple[float, float]:
    """Return the inches of a figure of this box, with room for labels and a legend."""
    ratio = (box[3] - box[2]) / (box[1] - box[0])
    height = min((width - 0.75) * ratio, tallest)
    return max(height / ratio + 0.75, 4.2), height + 1.1


def draw_scan(
    axes: Axes,
    detections: ScanDetections,
    box: Sequence[float],
    radius: float,
    readings: bool = True,
) -> None:
    """Draw a scan from above in a box (left, right, bottom, top), with its detections."""
    snapshot = detections.snapshot
    left, right, bottom, top = box
    _field(axes, snapshot)
    _world(axes, snapshot)
    if readings:
        points = transform(snapshot.pose, snapshot.scan.points[usable(snapshot.scan)])
        axes.plot(*points.T, ".", ms=3.2, mew=0, color=READING, zorder=4, label="reading")
    _findings(axes, snapshot, detections.true, TRUE, radius)
    _findings(axes, snapshot, detections.spurious, SPURIOUS, radius)
    _robot(axes, snapshot.pose)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set(xlabel="x in m", ylabel="y in m")
    quiet(axes)


def add_legend(figure: Any, detections: ScanDetections, columns: int) -> None:
    """Put the legend above a figure of scans from above."""
    figure.legend(handles=_keys(detections), loc="outside upper center", ncols=columns, **LEGEND)


def _field(axes: Axes, snapshot: SceneSnapshot) -> None:
    """Draw how far and wide the lidar sees."""
    x, y, heading = compose(snapshot.pose, snapshot.scan.laser)
    low, high = np.degrees(heading + snapshot.scan.angles[[0, -1]])
    axes.add_patch(Wedge((x, y), snapshot.scan.range_max, low, high, fc=FIELD, ec="none", zorder=0))


def _world(axes: Axes, snapshot: SceneSnapshot) -> None:
    """Draw the true scene: straight things, round things, and legs."""
    draw_scene(axes, snapshot.scene, snapshot.leaves, 4.0)
    for x, y, radius in snapshot.legs:
        axes.add_patch(Circle((x, y), radius, fc=LEG, ec="#c97a1c", lw=1.0, zorder=2))


def _robot(axes: Axes, pose: Array) -> None:
    """Draw the robot's outline with its bow."""
    shape = 0.8 * ROBOT * np.array([[1.0, 0.0], [-0.7, 0.65], [-0.4, 0.0], [-0.7, -0.65]])
    options: dict[str, Any] = {"fc": INK, "ec": "white", "lw": 0.8, "zorder": 8}
    axes.add_patch(Polygon(transform(pose, shape), **options))


def _findings(
    axes: Axes, snapshot: SceneSnapshot, found: Sequence[Observation], colour: str, radius: float
) -> None:
    spurious = colour == SPURIOUS
    style: Any = (0, (3, 1.2)) if spurious else "-"
    for finding in found:
        if finding.end_points is not None:
            ends = transform(snapshot.pose, finding.end_points)
            axes.plot(*ends.T, color=colour, lw=2.4, ls=style, zorder=6, gid="wall")
            continue
        x, y = transform(snapshot.pose, finding.z[None])[0]
        axes.add_patch(Circle((x, y), radius, fill=False, ec=colour, lw=2.0, ls=style, zorder=6))
        axes.plot(x, y, "x" if spurious else "+", ms=7, mew=1.6, color=colour, zorder=7)


def _keys(detections: ScanDetections) -> list[Any]:
    """Return the legend entries of the true scene."""
    snapshot, found = detections.snapshot, (*detections.true, *detections.spurious)
    kind = found[0].kind if found else ""
    bad: dict[str, Any] = {"color": SPURIOUS, "lw": 2.2, "ls": (0, (3, 1.2))}
    entries = [
        (True, Line2D([], [], color=INK, marker=(3, 0, -90), ls="", ms=9, label="robot")),
        (True, Patch(fc=FIELD, ec=GROUND, lw=0.5, label="field of view")),
        (True, Line2D([], [], color=GROUND, lw=4, label="truth")),
        (len(snapshot.legs) > 0, _dot("leg", LEG, "#c97a1c")),
        (True, Line2D([], [], color=READING, marker=".", ls="", label="reading")),
        (
            bool(detections.true),
            Line2D([], [], color=TRUE, lw=2.4, label=f"{kind}, true ({len(detections.true)})"),
        ),
        (
            bool(detections.spurious),
            Line2D([], [], label=f"{kind}, spurious ({len(detections.spurious)})", **bad),
        ),
    ]
    return [handle for there, handle in entries if there]


def _dot(label: str, face: str, edge: str) -> Line2D:
    return Line2D([], [], marker="o", ls="", ms=7, mfc=face, mec=edge, label=label)


def camera_figure(shown: ScanDetections) -> Figure:
    """Return the view of the robot's camera at the pose of the scan."""
    snapshot = shown.snapshot
    picture = SceneCamera(snapshot.scene).picture(snapshot.pose, snapshot.time)
    figure = new_figure(WIDTH, WIDTH * picture.shape[0] / picture.shape[1])
    axes: Any = figure.subplots()
    axes.imshow(picture[:, :, ::-1])  # OpenCV's order is blue, green, red
    axes.set_axis_off()
    return figure
