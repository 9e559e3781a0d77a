"""The picture of `imp reproduce filters`.

Importing this module imports matplotlib (0.3 s); import it where a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from impslam.evaluation.colours import INK
from impslam.evaluation.plots import new_figure

IDEAL = 3.0  # the pose's degrees of freedom


def draw_nees(cells: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Return a panel for each data set: mean NEES of each filter, low and high end of its interval."""
    figure = new_figure(9.0, 3.4)
    panels = figure.subplots(1, len(cells), sharey=True, squeeze=False)[0]
    names = list(dict.fromkeys(name for found in cells.values() for name in found))
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
