"""Arrays that grow by rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


class GrowingArray:
    """An array that grows by rows; views returned earlier, and copies, do not change."""

    def __init__(self, *shape: int, dtype: npt.DTypeLike = np.float64) -> None:
        self._rows: npt.NDArray[Any] = np.empty((64, *shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __copy__(self) -> GrowingArray:
        """Return an independent array; no rows are copied until it grows."""
        other = object.__new__(GrowingArray)
        other._rows, other._count = self._rows[: self._count], self._count
        return other

    def append(self, rows: npt.ArrayLike, m: int = 1) -> None:
        """Append m rows (m, ...), or one value to each of m rows."""
        end = self._count + m
        if end > len(self._rows):
            size = max(end, 2 * len(self._rows))
            grown = np.empty((size, *self._rows.shape[1:]), self._rows.dtype)
            grown[: self._count] = self._rows[: self._count]
            self._rows = grown
        self._rows[self._count : end] = rows
        self._count = end

    def shorten(self, rows: int) -> None:
        """Remove `rows` rows from the end; views returned earlier keep their values."""
        self._rows, self._count = self._rows.copy(), self._count - rows

    def replace(self, at: npt.NDArray[Any], rows: npt.NDArray[Any]) -> None:
        """Overwrite the rows `at`; views returned earlier keep their values."""
        self._rows = self._rows.copy()
        self._rows[at] = rows

    def remove(self, at: npt.NDArray[Any]) -> None:
        """Remove the rows `at`; views returned earlier keep their values."""
        self._rows = np.delete(self._rows[: self._count], at, axis=0)
        self._count = len(self._rows)

    @property
    def array(self) -> npt.NDArray[Any]:
        """The current rows (n, ...), read-only."""
        view = self._rows[: self._count]
        view.flags.writeable = False
        return view
