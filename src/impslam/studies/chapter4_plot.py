"""Figures of Chapter IV: ranges and their derivative, scans from above.

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

from impslam.evaluation.colours import INK, PALE
from impslam.evaluation.plots import new_figure, quiet
from impslam.extractors.readings import usable
from impslam.geometry.se2 import compose, transform
from impslam.simulation.camera import SceneCamera
from impslam.studies.chapter4_scans import Detections, Jumps, SceneSnapshot
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


# --------------------------------------------------------------------------- range and derivative


def jumps_figure(detections: Detections, seen: Jumps, threshold: float, radius: float) -> Figure:
    """Draw the scan from above, its ranges, and their derivative with the jumps (Fig. 11)."""
    figure = new_figure(WIDTH + 1.4, 6.4)
    panels: Any = figure.subfigures(1, 2, width_ratios=(1.0, 2.2))
    above, right = panels
    _scan(above.subplots(), detections, _bounds(detections.snapshot), radius)
    _legend(above, detections, 2)
    ranges, slopes = right.subplots(2, 1, sharex=True)
    degrees = np.degrees(seen.angles)
    echo = seen.ranges > 0.0
    ranges.plot(degrees[echo], seen.ranges[echo], ".", ms=2.5, color=READING, label="range")
    if not echo.all():
        options: dict[str, Any] = {"ms": 5, "color": SPURIOUS, "label": "no echo: 0"}
        ranges.plot(degrees[~echo], seen.ranges[~echo], "x", **options)
    _objects(ranges, slopes, detections, seen)
    _slopes(slopes, seen, threshold)
    ranges.set_ylabel("range in m")
    slopes.set(ylabel="d range / d angle in m/rad", xlabel="angle of the beam in degrees")
    for axes in (ranges, slopes):
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, **LEGEND)
        quiet(axes)
    return figure


def _objects(ranges: Axes, slopes: Axes, detections: Detections, seen: Jumps) -> None:
    """Shade the objects that were accepted as cylinders, and the rejected ones."""
    begins = {int(o.beams[0]) for o in (*detections.true, *detections.spurious)}
    labels = {True: "taken for a cylinder", False: "dropped: no range in the middle"}
    for begin, end in seen.objects:
        taken = int(begin) in begins
        span = np.degrees(seen.angles[[begin, end]]) + np.array([-0.4, 0.4])
        options: dict[str, Any] = {"color": TRUE if taken else SPURIOUS, "alpha": 0.16, "lw": 0}
        ranges.axvspan(*span, label=labels.pop(taken, None), **options)
        slopes.axvspan(*span, **options)


def _slopes(axes: Axes, seen: Jumps, threshold: float) -> None:
    degrees = np.degrees(seen.between)
    axes.plot(degrees, seen.slopes, color=READING, lw=0.8)
    for sign in (-1.0, 1.0):
        label = f"threshold ±{threshold:g} m/rad" if sign > 0.0 else None
        axes.axhline(sign * threshold, color=PALE, lw=1.0, ls=(0, (4, 3)), label=label)
    options: dict[str, Any] = {"ls": "", "ms": 7, "mec": "white", "mew": 0.6}
    begins, ends = seen.falls, seen.rises
    axes.plot(degrees[begins], seen.slopes[begins], "v", color="#15803d", label="begins", **options)
    axes.plot(degrees[ends], seen.slopes[ends], "^", color="#f2a03d", label="ends", **options)
    # Linear up to the threshold, logarithmic beyond: a lost beam jumps ten times as far.
    axes.set_yscale("symlog", linthresh=threshold, linscale=1.0)
    ticks = threshold * np.array([-16.0, -4.0, -1.0, 0.0, 1.0, 4.0, 16.0])
    axes.set_yticks(ticks, [f"{tick:g}".replace("-", "−") for tick in ticks])
    axes.minorticks_off()


# --------------------------------------------------------------------------- from above


def scan_figure(detections: Detections, radius: float = 0.0) -> Figure:
    """Draw a scan from above: the truth in pale colours, readings, true and spurious detections.

    `radius` (m) is that of the detected cylinders.
    """
    box = _bounds(detections.snapshot)
    figure = new_figure(*_size(box, WIDTH, 7.4))
    _scan(figure.subplots(), detections, box, radius)
    _legend(figure, detections, 4 if _is_wide(box) else 2)
    return figure


def people_figure(detections: Detections) -> Figure:
    """Draw the true scene with people beside (or above) the detected walls (Figs. 18, 19)."""
    box = _bounds(detections.snapshot)
    wide = _is_wide(box)
    width, height = _size(box, WIDTH if wide else WIDTH / 2, 6.4)
    figure = new_figure(width, 2 * height) if wide else new_figure(2 * width, height)
    panels = list(figure.subplots(2 if wide else 1, 1 if wide else 2, squeeze=False).flat)
    bare = Detections(detections.snapshot, (), ())
    _scan(panels[0], bare, box, 0.0, readings=False)
    _scan(panels[1], detections, box, 0.0)
    for axes, title in zip(panels, ("(a) the scene", "(b) readings and walls found"), strict=True):
        axes.set_title(title, loc="left", color=INK, fontsize=10)
    _legend(figure, detections, 4)
    return figure


def _is_wide(box: Sequence[float]) -> bool:
    return box[1] - box[0] > 1.5 * (box[3] - box[2])


def _bounds(snapshot: SceneSnapshot) -> tuple[float, float, float, float]:
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


def _scan(
    axes: Axes, detections: Detections, box: Sequence[float], radius: float, readings: bool = True
) -> None:
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


def _legend(figure: Any, detections: Detections, columns: int) -> None:
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


def _keys(detections: Detections) -> list[Any]:
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


def camera_figure(shown: Detections) -> Figure:
    """Return the view of the robot's camera at the pose of the scan."""
    snapshot = shown.snapshot
    picture = SceneCamera(snapshot.scene).picture(snapshot.pose, snapshot.time)
    figure = new_figure(WIDTH, WIDTH * picture.shape[0] / picture.shape[1])
    axes: Any = figure.subplots()
    axes.imshow(picture[:, :, ::-1])  # OpenCV's order is blue, green, red
    axes.set_axis_off()
    return figure
