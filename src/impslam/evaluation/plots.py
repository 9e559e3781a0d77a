"""Looks that the figures share.

Importing this module imports matplotlib (0.4 s); import it where a figure is drawn. Figures are drawn
on their own canvas, without pyplot and its global state.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib.figure import Figure

from impslam.evaluation.colours import INK, PALE

TIGHT: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.12}
"""How a picture is cut to what is drawn."""


def as_png(figure: Figure, **look: Any) -> bytes:
    """Return a figure as a PNG, the same bytes for the same picture; `look` is `savefig`'s."""
    stream = io.BytesIO()
    plain = {"Software": None}  # no version in the file
    figure.savefig(stream, format="png", metadata=plain, **look)
    return stream.getvalue()


def style(axes: Any) -> None:
    """Give axes of a map their labels and quiet colours."""
    axes.set_xlabel("x in m", color=INK)
    axes.set_ylabel("y in m", color=INK)
    axes.tick_params(colors=PALE, labelcolor=INK, labelsize=9)
    axes.grid(color="#000000", alpha=0.06, lw=0.6)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#d4d9de")
