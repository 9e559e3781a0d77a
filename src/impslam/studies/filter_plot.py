"""Figure of `imp reproduce filters`.

Importing this module imports matplotlib (0.3 s); import it only to draw.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from impslam.evaluation.colours import INK
from impslam.evaluation.plots import new_figure

IDEAL = 3.0  # the pose's degrees of freedom
COLUMNS = 4


def draw_nees(cells: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Return a figure with a panel for each data set: mean NEES of each filter, with its interval."""
    columns = min(COLUMNS, len(cells))
    rows = -(-len(cells) // columns)
    figure = new_figure(9.0, 3.4 * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    panels, spare = grid.flat[: len(cells)], grid.flat[len(cells) :]
    names = list(dict.fromkeys(name for found in cells.values() for name in found))
    for axes in spare:
        axes.remove()
    for axes, (data, found) in zip(panels, cells.items(), strict=True):
        axes.axvline(IDEAL, color="#9aa5b1", lw=1.0)
        for name, (value, low, high) in found.items():
            row = names.index(name)
            axes.plot([low, high], [row, row], "-", color=INK, lw=1.2)
            axes.plot([value], [row], "o", color=INK, ms=4)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        if high < 100.0 * low:
            axes.set_xticks([n for n in (1, 2, 3, 5, 10, 20, 50, 100) if low <= n <= high])
            axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_title(data, fontsize="medium", loc="left")
        axes.set_xlabel("pose NEES")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    return figure
