"""Tables of runs side by side, with the best of each column in bold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich import box
from rich.console import JustifyMethod
from rich.table import Table
from rich.text import Text

from impslam.cli import console


@dataclass(frozen=True, slots=True)
class Cell:
    """What a cell says, and how far from the best it could be; NaN where that is no question."""

    text: str
    badness: float = math.nan


def show(header: Sequence[str], rows: Mapping[tuple[str, ...], Sequence[Cell]]) -> None:
    """Print a table: labels flush left, then numbers, the best of each column in bold.

    The first label is the run; rows that share the others are compared with one another.
    """
    words = len(next(iter(rows)))
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for i, name in enumerate(header):
        justify: JustifyMethod = "left" if i < words else "right"
        table.add_column(Text(name), justify=justify, overflow="fold")
    for labels, cells in rows.items():
        rivals = [other for key, other in rows.items() if key[1:] == labels[1:]]
        best = [_best(column) for column in zip(*rivals, strict=True)]
        looks = ["bold" if c.text == text else "" for c, text in zip(cells, best, strict=True)]
        numbers = (Text(c.text, look) for c, look in zip(cells, looks, strict=True))
        table.add_row(*map(Text, labels), *numbers)
    console.show_indented(table, 0)


def _best(column: Sequence[Cell]) -> str | None:
    """Return what the best cells say, or None where all are known to be as good."""
    known = [cell for cell in column if math.isfinite(cell.badness)]
    if len({cell.text for cell in known}) < 2:
        return None
    return min(known, key=lambda cell: cell.badness).text
