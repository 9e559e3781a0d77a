"""Figure of the Hough transform of Chapter IV: image, accumulator, and peaks.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from impslam.evaluation.colours import INK, PALE
from impslam.evaluation.plots import new_figure
from impslam.extractors.hough import Hough
from impslam.extractors.readings import usable
from impslam.studies.chapter4_detections import ScanDetections
from impslam.studies.chapter4_plot import LEGEND, SPURIOUS, TRUE, WIDTH
from impslam.types import Array, Observation

BOW = "#f2a03d"
POOL = 4
"""Cells of the accumulator drawn as one: single cells would be thinner than a pixel."""


def pixels(scan_points: Array, hough: Hough) -> Array:
    """Return the white pixels (k, 2), columns and rows, of points in base_link (Eq. 4.13)."""
    middle = hough.size // 2
    x, y = scan_points.T / hough.resolution
    both = np.unique(np.rint(np.column_stack((middle - y, middle + x))), axis=0)
    inside = ((both >= 0.0) & (both < hough.size)).all(axis=1)
    return np.asarray(both[inside], dtype=np.float64)


def accumulator(white: Array, hough: Hough) -> tuple[Array, Array, Array]:
    """Return the votes (t, m) of white pixels (k, 2), the angles (t,) rad and distances (m,) px.

    Thesis Eq. 4.10 to 4.12: a pixel votes, for each angle, for the cell of its distance.
    """
    thetas: Array = np.arange(0.0, math.pi - 1e-9, hough.angle_bin, dtype=np.float64)
    step = hough.rho_bin / hough.resolution
    cells = math.ceil(math.sqrt(2.0) * hough.size / step)
    distances: Array = step * np.arange(-cells, cells + 1, dtype=np.float64)
    votes = np.zeros((len(thetas), len(distances)))
    for row, theta in zip(votes, thetas, strict=True):
        off = white @ np.array([math.cos(theta), math.sin(theta)])
        np.add.at(row, np.rint(off / step).astype(np.int64) + cells, 1.0)
    return votes, thetas, distances


def peak(finding: Observation, hough: Hough) -> tuple[float, float]:
    """Return the angle in [0, pi) and the distance in px, in the image, of a wall in base_link."""
    rho, alpha = (float(v) for v in finding.z)
    middle = hough.size // 2
    distance = rho / hough.resolution + middle * (math.cos(alpha) - math.sin(alpha))
    half_turns, theta = divmod(alpha + 0.5 * math.pi + 1e-9, math.pi)
    return theta - 1e-9, distance if half_turns % 2 == 0 else -distance


def hough_figure(detections: ScanDetections, hough: Hough) -> Figure:
    """Draw the binary image with the detected lines, and the accumulator with their cells."""
    figure = new_figure(WIDTH + 1.2, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.02))
    white = pixels(detections.snapshot.scan.points[usable(detections.snapshot.scan)], hough)
    left.set_facecolor("black")
    left.plot(*white.T, "s", ms=1.6, mew=0, color="white")
    middle = hough.size // 2  # the robot faces down: Eq. 4.13 maps x forward to rows
    left.plot(middle, middle, marker=(3, 0, 180), ms=9, color=BOW, ls="")
    left.set(xlim=(0, hough.size), ylim=(hough.size, 0), aspect="equal")
    left.set(xlabel="column in pixels", ylabel="row in pixels")
    _cells(figure, right, white, hough)
    _mark(left, right, detections, hough)
    return figure


def _cells(figure: Figure, axes: Axes, white: Array, hough: Hough) -> None:
    """Draw the accumulator; each drawn cell is the maximum over `POOL` distances."""
    votes, thetas, distances = accumulator(white, hough)
    seen = np.flatnonzero(votes.any(axis=0))
    first, rows = int(seen[0]), -(-len(range(seen[0], seen[-1] + 1)) // POOL)
    votes = np.pad(votes, ((0, 0), (0, POOL)))[:, first : first + POOL * rows]
    strongest = votes.reshape(len(thetas), rows, POOL).max(axis=2)
    step = distances[1] - distances[0]
    low, half = distances[first] - 0.5 * step, 0.5 * math.degrees(hough.angle_bin)
    top = math.degrees(thetas[-1]) + half
    shown = axes.imshow(
        strongest.T,
        extent=(-half, top, low, low + POOL * rows * step),
        origin="lower",
        aspect="auto",
        cmap="Greys",
        norm=PowerNorm(0.5),
        interpolation="nearest",
    )
    axes.set(xlabel="angle θ in degrees", ylabel="distance r in pixels", box_aspect=1.0)
    bar = figure.colorbar(shown, ax=axes, label="votes in white pixels", shrink=0.8)
    bar.ax.tick_params(colors=PALE, labelcolor=INK, labelsize=9)


def _mark(image: Axes, cells: Axes, detections: ScanDetections, hough: Hough) -> None:
    """Draw each wall as a line across the image and a ring around its cell."""
    keys = [
        Line2D([], [], marker="s", ls="", ms=6, mfc="white", mec="black", label="reading"),
        Line2D([], [], marker=(3, 0, 180), ls="", ms=9, color=BOW, label="robot"),
    ]
    for found, colour, word in (
        (detections.true, TRUE, "true"),
        (detections.spurious, SPURIOUS, "spurious"),
    ):
        ring: dict[str, Any] = {"marker": "o", "ms": 11, "mfc": "none", "mec": colour, "mew": 1.8}
        for finding in found:
            theta, distance = peak(finding, hough)
            normal = np.array([math.cos(theta), math.sin(theta)])
            ends = distance * normal + np.outer([-1e4, 1e4], [-normal[1], normal[0]])
            image.plot(*ends.T, color=colour, lw=1.4)
            cells.plot(math.degrees(theta), distance, ls="", **ring)
        if found:
            label = f"wall, {word} ({len(found)})"
            keys.append(Line2D([], [], color=colour, lw=1.4, label=label, **ring))
    image.figure.legend(handles=keys, loc="outside upper center", ncols=4, **LEGEND)
    for axes in (image, cells):
        axes.tick_params(colors=PALE, labelcolor=INK, labelsize=9)
