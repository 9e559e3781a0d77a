"""The figure of Chapter IV on ranges and their derivative.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from impslam.evaluation.colours import PALE
from impslam.evaluation.plots import new_figure, quiet
from impslam.studies.chapter4_detections import Jumps, ScanDetections
from impslam.studies.chapter4_plot import (
    LEGEND,
    READING,
    SPURIOUS,
    TRUE,
    WIDTH,
    add_legend,
    bounds,
    draw_scan,
)


def jumps_figure(
    detections: ScanDetections, seen: Jumps, threshold: float, radius: float
) -> Figure:
    """Draw the scan from above, its ranges, and their derivative with the jumps (Fig. 11)."""
    figure = new_figure(WIDTH + 1.4, 6.4)
    panels: Any = figure.subfigures(1, 2, width_ratios=(1.0, 2.2))
    above, right = panels
    draw_scan(above.subplots(), detections, bounds(detections.snapshot), radius)
    add_legend(above, detections, 2)
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


def _objects(ranges: Axes, slopes: Axes, detections: ScanDetections, seen: Jumps) -> None:
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
