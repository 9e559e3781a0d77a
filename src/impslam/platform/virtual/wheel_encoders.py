"""The absolute encoders as the micro-controller's converter reads them, and its accumulators."""

from __future__ import annotations

import math

import numpy as np

from impslam.platform.devices.autopilot_messages import ADC_STEPS
from impslam.platform.devices.wheel_counter import wrapped_difference

CUT_OFF = 950.0
"""Hz, of the low-pass before the converter (thesis 3.3): the drop at 5 V takes 0.2 ms."""
MAX_SPEED = 20
"""steps/ms, 1.9 m/s of a 5 in wheel, twice its top speed; more is a reading in the drop."""
MAX_JUMPS = 3  # consecutive jumps that are ignored; then the wheel has really turned


class AbsoluteEncoder:
    """An MA3 with its filter: 0 to 5 V over a turn, then a drop to 0, read with 12 bits.

    Parameters
    ----------
    rng : of the converter's noise
    noise : standard deviation, steps: 0.03 deg by the data sheet of the 12-bit version
    """

    def __init__(self, rng: np.random.Generator, noise: float = 0.35) -> None:
        self._rng, self._noise = rng, noise
        self._turns: float | None = None
        self._time = 0.0

    def read(self, angle: float, time: float) -> int:
        """Return the converter's reading for the wheel's angle in rad."""
        turns = angle / (2.0 * math.pi)
        steps = ADC_STEPS * (turns - math.floor(turns)) + self._filter_residual(turns, time)
        self._turns, self._time = turns, time
        return round(steps + self._noise * self._rng.standard_normal()) % ADC_STEPS

    def _filter_residual(self, turns: float, time: float) -> float:
        """Return the remaining deviation of the filter after a drop or rise, steps."""
        if self._turns is None or math.floor(turns) == math.floor(self._turns):
            return 0.0
        forward = turns > self._turns
        edge = math.floor(turns) if forward else math.floor(turns) + 1
        since = (turns - edge) / (turns - self._turns) * (time - self._time)
        left = ADC_STEPS * math.exp(-2.0 * math.pi * CUT_OFF * since)
        return left if forward else -left


class Accumulator:
    """Accumulates the steps of an absolute encoder, as the firmware does every millisecond.

    The wrapped difference of readings is used, so that the drop at the end of a turn, and noise around
    it, cause no error; a reading within the drop is ignored (docs/autopilot-protocol.md).
    """

    def __init__(self) -> None:
        self.count = 0
        self.reading: int | None = None
        self._jumps, self._time = 0, 0.0

    def add(self, reading: int, time: float) -> None:
        """Add a reading in steps of the converter."""
        if self.reading is None:
            self.reading, self._time = reading, time
            return
        difference = wrapped_difference(reading - self.reading, ADC_STEPS)
        if (
            abs(difference) > MAX_SPEED * max(1.0, 1e3 * (time - self._time))
            and self._jumps < MAX_JUMPS
        ):
            self._jumps += 1
            return
        self.count += difference
        self.reading, self._time, self._jumps = reading, time, 0
