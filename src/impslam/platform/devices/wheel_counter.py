"""The angle of a wheel from its encoder's accumulator, across wraps and reboots of the counter."""

from __future__ import annotations

import math


class WheelCounter:
    """Converts a 32-bit accumulator to a continuous angle.

    After a restart of the accumulator, the absolute encoder gives the rotation since the last reading,
    except for whole turns: the smaller of the two possible rotations is taken.

    Parameters
    ----------
    per_turn : counts of the accumulator per turn
    steps : steps of the absolute encoder per turn
    """

    def __init__(self, per_turn: int, steps: int) -> None:
        self._per_turn, self._steps = per_turn, steps
        self._count: int | None = None
        self._reading: int | None = None
        self._total = 0.0  # counts; exact up to 2^53

    def restart(self) -> None:
        """Handle a restart of the accumulator."""
        self._count = None

    def __call__(self, count: int, reading: int) -> float:
        """Return the angle in rad, 0 at the first reading.

        Parameters
        ----------
        count : the accumulator, signed 32 bits, wrapping
        reading : the absolute encoder, in [0, steps)
        """
        if self._count is not None:
            self._total += wrapped_difference(count - self._count, 1 << 32)
        elif self._reading is not None:
            gap = wrapped_difference(reading - self._reading, self._steps)
            self._total += gap * self._per_turn / self._steps
        self._count, self._reading = count, reading
        return 2.0 * math.pi * self._total / self._per_turn


def wrapped_difference(difference: int, span: int) -> int:
    """Return the difference of two readings that wrap at `span`, in [-span/2, span/2)."""
    return (difference + span // 2) % span - span // 2
