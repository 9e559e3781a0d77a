"""A wheel's angle from its encoder's accumulator, across wraps and across reboots of who counts."""

from __future__ import annotations

import math


class WheelCounter:
    """Turns a 32-bit accumulator into an angle that goes on.

    Where the accumulator began anew, the absolute encoder says how far the wheel has turned
    meanwhile, but for whole turns: the way to its reading is taken the shorter way round.

    Parameters
    ----------
    per_turn : counts of the accumulator in one turn
    steps : of the absolute encoder in one turn
    """

    def __init__(self, per_turn: int, steps: int) -> None:
        self._per_turn, self._steps = per_turn, steps
        self._count: int | None = None
        self._reading: int | None = None
        self._total = 0.0  # counts; exact up to 2^53

    def restart(self) -> None:
        """Know that the accumulator begins anew."""
        self._count = None

    def __call__(self, count: int, reading: int) -> float:
        """Return the angle in rad, 0 at the first reading.

        Parameters
        ----------
        count : the accumulator, signed 32 bits, wrapping
        reading : the absolute encoder, in [0, steps)
        """
        if self._count is not None:
            self._total += shorter_way(count - self._count, 1 << 32)
        elif self._reading is not None:
            gap = shorter_way(reading - self._reading, self._steps)
            self._total += gap * self._per_turn / self._steps
        self._count, self._reading = count, reading
        return 2.0 * math.pi * self._total / self._per_turn


def shorter_way(difference: int, span: int) -> int:
    """Return the difference of two readings that wrap at `span`, in [-span/2, span/2)."""
    return (difference + span // 2) % span - span // 2
