"""The clocks of a log's streams: put each batch of rows on the common time line of all streams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from impslam.columns import Columns
from impslam.odometry.clocks import BY_ORDER, Clocks, PlacedRows

STEP, UNUSABLE = "clock step", "unusable stamp"
"""Kinds of problem: a clock that was set, and a row whose stamp is not used."""

Reports: TypeAlias = list[tuple[int, str, str, int]]
"""Position in the log, kind, example, count."""


class StreamClocks:
    """Places the rows of streams on the common time line; see `clocks`."""

    def __init__(self) -> None:
        self._clocks, self._numbers = Clocks(), dict[str, int]()

    @property
    def elapsed(self) -> float:
        """Time since the first row, s on the common time line; NaN if few stamps are usable."""
        return self._clocks.elapsed

    def place(
        self, used: Sequence[Columns], odometry: str = ""
    ) -> tuple[list[PlacedRows], Reports]:
        """Return the times of the rows of each of the columns, and what was found in their stamps.

        `odometry` is the stream whose order the others follow; see `Clocks.place`.
        """
        if not used:
            return [], []
        order = np.concatenate([columns.order for columns in used])
        lengths = [len(columns) for columns in used]
        number = [self._numbers.setdefault(c.stream, len(self._numbers)) for c in used]
        streams = np.repeat(np.array(number), lengths)
        stamps = np.concatenate([columns.stamps for columns in used])
        sorting, back = np.argsort(order), np.empty(len(order), np.int64)
        back[sorting] = np.arange(len(order))
        reference = self._numbers.get(odometry, -1)
        placed, steps = self._clocks.place(streams[sorting], stamps[sorting], reference)
        names = list(self._numbers)
        reports: Reports = [
            (
                int(order[sorting[step.row]]),
                STEP,
                f"the clock {step} ({names[step.stream]}); motion is kept in file order",
                1,
            )
            for step in steps
        ]
        parts = np.split(back, np.cumsum(lengths)[:-1])
        each = [placed.take(part) for part in parts]
        for columns, rows in zip(used, each, strict=True):
            reports += _unusable(columns, rows)
        return each, reports


def _unusable(columns: Columns, placed: PlacedRows) -> Reports:
    """Report the rows whose own stamps are not used, if there are any."""
    wrong = placed.how == BY_ORDER
    if not wrong.any():
        return []
    first = int(np.argmax(wrong))
    text = (
        f"the stamp {columns.stamps[first]:.3f} s of {columns.stream} contradicts the order of the log "
        f"at {placed.times[first]:.3f} s; such rows are used in file order, and no motion is lost"
    )
    return [(int(columns.order[first]), UNUSABLE, text, int(wrong.sum()))]
