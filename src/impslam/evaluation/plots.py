"""Shared style of figures.

Importing this module imports matplotlib (0.4 s); import it only to draw. Figures are drawn on their own
canvas, without pyplot and its global state.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from impslam.evaluation.colours import INK, PALE

MAX_NAME = 30
"""Characters of a name; a longer one is shortened in the middle."""
TIGHT: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.12}
"""Options of `savefig` that crop a picture to its content."""


def shortened(name: str) -> str:
    """Return a name of at most `MAX_NAME` characters."""
    half = MAX_NAME // 2
    return name if len(name) <= MAX_NAME else f"{name[:half]}…{name[1 - half :]}"


def new_figure(width: float, height: float, **options: Any) -> Figure:
    """Return an empty figure on its own canvas, size in inches; `options` are passed to `Figure`."""
    figure = Figure(figsize=(width, height), **{"layout": "constrained", **options})
    FigureCanvasAgg(figure)
    return figure


def as_png(figure: Figure, **options: Any) -> bytes:
    """Return a figure as a reproducible PNG; `options` are passed to `savefig`."""
    stream = io.BytesIO()
    plain = {"Software": None}  # no version in the file
    figure.savefig(stream, format="png", metadata=plain, **options)
    return stream.getvalue()


def as_svg(figure: Figure, **options: Any) -> bytes:
    """Return a figure as a reproducible SVG; see `as_png`."""
    stream = io.BytesIO()
    with rc_context({"svg.hashsalt": "impslam", "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, **options)
    return stream.getvalue()


def style(axes: Any) -> None:
    """Set the labels and quiet colours of the axes of a map."""
    axes.set_xlabel("x in m")
    axes.set_ylabel("y in m")
    quiet(axes)


def quiet(axes: Any) -> None:
    """Set quiet colours and a faint grid."""
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_color(INK)
    axes.tick_params(colors=PALE, labelcolor=INK, labelsize=9)
    axes.grid(color="#000000", alpha=0.06, lw=0.6)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#d4d9de")
