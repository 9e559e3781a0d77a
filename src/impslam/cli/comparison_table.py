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
    """Text of a cell and how bad its value is, 0 at best; NaN if it cannot be compared."""

    text: str
    badness: float = math.nan


def show(header: Sequence[str], rows: Mapping[tuple[str, ...], Sequence[Cell]]) -> None:
    """Print a table of labels and numbers, with the best of each column in bold.

    The first label is the run; rows that share the other labels are compared with one another.
    """
    labels_count = len(next(iter(rows)))
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for i, name in enumerate(header):
        justify: JustifyMethod = "left" if i < labels_count else "right"
        table.add_column(Text(name), justify=justify, overflow="fold")
    for labels, cells in rows.items():
        rivals = [other for key, other in rows.items() if key[1:] == labels[1:]]
        best = [_best(column) for column in zip(*rivals, strict=True)]
        styles = ["bold" if c.text == text else "" for c, text in zip(cells, best, strict=True)]
        numbers = (Text(c.text, style) for c, style in zip(cells, styles, strict=True))
        table.add_row(*map(Text, labels), *numbers)
    console.print_table(table)


def _best(column: Sequence[Cell]) -> str | None:
    """Return the text of the best cells, or None if there is nothing to compare."""
    known = [cell for cell in column if math.isfinite(cell.badness)]
    if len({cell.text for cell in known}) < 2:
        return None
    return min(known, key=lambda cell: cell.badness).text
