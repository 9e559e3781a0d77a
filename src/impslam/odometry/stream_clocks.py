"""The clocks of a log's streams: each batch of rows on the time line that all streams share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.columns import Columns
from impslam.odometry.clocks import Clocks
from impslam.types import Array


class StreamClocks:
    """Computes by how much the stamps of streams are off the common time line; see `clocks`."""

    def __init__(self) -> None:
        self._clocks, self._numbers = Clocks(), dict[str, int]()

    @property
    def elapsed(self) -> float:
        """Time since the first row, s on the common time line."""
        return self._clocks.elapsed

    def shifts(self, used: Sequence[Columns]) -> tuple[list[Array], list[tuple[int, str]]]:
        """Return the shifts (m,) s of the rows of each of the columns, and the clocks that were set.

        These are the position in the log where it was detected, and a line on it.
        """
        if not used:
            return [], []
        order = np.concatenate([columns.order for columns in used])
        lengths = [len(columns) for columns in used]
        number = [self._numbers.setdefault(c.stream, len(self._numbers)) for c in used]
        streams = np.repeat(np.array(number), lengths)
        stamps = np.concatenate([columns.stamps for columns in used])
        place, shifts = np.argsort(order), np.empty(len(order))
        shifts[place], steps = self._clocks.shifts(streams[place], stamps[place])
        names = list(self._numbers)
        told = [
            (
                int(order[place[step.row]]),
                f"the clock {step} ({names[step.stream]}); motion is kept in file order",
            )
            for step in steps
        ]
        return np.split(shifts, np.cumsum(lengths)[:-1]), told
