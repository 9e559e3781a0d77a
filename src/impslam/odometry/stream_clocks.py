"""The clocks of a log's streams: put each batch of rows on the common time line of all streams."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.columns import Columns
from impslam.odometry.clocks import Clocks
from impslam.types import Array


class StreamClocks:
    """Computes the shifts of streams to the common time line; see `clocks`."""

    def __init__(self) -> None:
        self._clocks, self._numbers = Clocks(), dict[str, int]()

    @property
    def elapsed(self) -> float:
        """Time since the first row, s on the common time line."""
        return self._clocks.elapsed

    def shifts(self, used: Sequence[Columns]) -> tuple[list[Array], list[tuple[int, str]]]:
        """Return the shifts (m,) s of the rows of each of the columns, and the clocks that were set.

        The latter are pairs of the position in the log where the step was detected, and a message.
        """
        if not used:
            return [], []
        order = np.concatenate([columns.order for columns in used])
        lengths = [len(columns) for columns in used]
        number = [self._numbers.setdefault(c.stream, len(self._numbers)) for c in used]
        streams = np.repeat(np.array(number), lengths)
        stamps = np.concatenate([columns.stamps for columns in used])
        sorting, shifts = np.argsort(order), np.empty(len(order))
        shifts[sorting], steps = self._clocks.shifts(streams[sorting], stamps[sorting])
        names = list(self._numbers)
        reports = [
            (
                int(order[sorting[step.row]]),
                f"the clock {step} ({names[step.stream]}); motion is kept in file order",
            )
            for step in steps
        ]
        return np.split(shifts, np.cumsum(lengths)[:-1]), reports
