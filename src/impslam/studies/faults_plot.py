"""Figure of fault injection: a square for each run, coloured by its verdict.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from impslam.evaluation.colours import INK
from impslam.evaluation.plots import new_figure
from impslam.studies.fault_scores import VERDICTS
from impslam.sweeps.rows import Row

COLOURS = dict(zip(VERDICTS, ("#dfe3e8", "#15803d", "#86c79a", "#f2a03d", "#d81b60"), strict=True))
MIN_WIDTH = 3.2
"""Squares, width needed for the name of a drive."""


def draw_verdicts(rows: Sequence[Row]) -> Figure:
    """Return a figure of all runs; save it with `figure.savefig(path)`."""
    faults = list(dict.fromkeys(row["fault"] for row in rows))
    drives = list(dict.fromkeys(row["drive"] for row in rows))
    seeds = list(dict.fromkeys(row["seed"] for row in rows))
    wide = max(len(seeds) + 0.6, MIN_WIDTH)
    figure = new_figure(3.2 + 0.24 * wide * len(drives), 0.9 + 0.24 * len(faults))
    axes = figure.add_subplot()
    for row in rows:
        x = drives.index(row["drive"]) * wide + seeds.index(row["seed"])
        corner = x + 0.06, faults.index(row["fault"]) + 0.06
        axes.add_patch(Rectangle(corner, 0.88, 0.88, color=COLOURS[row["verdict"]], lw=0))
    axes.set_xlim(-0.6, wide * len(drives) - 0.6)
    axes.set_ylim(len(faults), 0.0)
    axes.set_xticks([k * wide + 0.5 * len(seeds) for k in range(len(drives))], drives)
    axes.set_yticks([k + 0.5 for k in range(len(faults))], faults)
    axes.tick_params(length=0, labelsize=8, labelcolor=INK)
    axes.xaxis.tick_top()
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_aspect("equal")
    keys = [Rectangle((0, 0), 1, 1, color=COLOURS[verdict]) for verdict in VERDICTS]
    figure.legend(keys, VERDICTS, loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    return figure
