"""The two absolute encoders as the micro-controller's converter sees them, and its accumulators."""

from __future__ import annotations

import math

import numpy as np

from impslam.platform.devices.autopilot_messages import ADC_STEPS
from impslam.platform.devices.wheel_counter import shorter_way

CUT_OFF = 950.0  # Hz, the low-pass before the converter (thesis 3.3): the drop at 5 V takes 0.2 ms
FASTEST = 20  # steps a ms, 1.9 m/s of a 5 in wheel, twice its top: more was read within the drop
PATIENCE = 3  # jumps in a row that are believed: the wheel was turned while nobody looked


class AbsoluteEncoder:
    """An MA3 behind its filter: 0 to 5 V over a turn and then down again, read with 12 bits.

    Parameters
    ----------
    rng : of the converter's noise
    noise : steps, standard deviation: 0.03 deg by the data sheet of the 12-bit kind
    """

    def __init__(self, rng: np.random.Generator, noise: float = 0.35) -> None:
        self._rng, self._noise = rng, noise
        self._turns: float | None = None
        self._time = 0.0

    def read(self, angle: float, time: float) -> int:
        """Return the converter's reading for the wheel's angle in rad."""
        turns = angle / (2.0 * math.pi)
        steps = ADC_STEPS * (turns - math.floor(turns)) + self._left_of_drop(turns, time)
        self._turns, self._time = turns, time
        return round(steps + self._noise * self._rng.standard_normal()) % ADC_STEPS

    def _left_of_drop(self, turns: float, time: float) -> float:
        """Return how far the filter still is from where it goes, in steps, after a drop or rise."""
        if self._turns is None or math.floor(turns) == math.floor(self._turns):
            return 0.0
        forward = turns > self._turns
        edge = math.floor(turns) if forward else math.floor(turns) + 1
        since = (turns - edge) / (turns - self._turns) * (time - self._time)
        left = ADC_STEPS * math.exp(-2.0 * math.pi * CUT_OFF * since)
        return left if forward else -left


class Accumulator:
    """Counts an absolute encoder's way, as the firmware does every millisecond.

    The shorter way from reading to reading, so that the drop at a turn's end, and noise about it,
    cost nothing; a reading within the drop is left out (docs/autopilot-protocol.md).
    """

    def __init__(self) -> None:
        self.count = 0
        self.reading: int | None = None
        self._jumps, self._time = 0, 0.0

    def add(self, reading: int, time: float) -> None:
        """Take a reading in steps of the converter."""
        if self.reading is None:
            self.reading, self._time = reading, time
            return
        way = shorter_way(reading - self.reading, ADC_STEPS)
        if abs(way) > FASTEST * max(1.0, 1e3 * (time - self._time)) and self._jumps < PATIENCE:
            self._jumps += 1
            return
        self.count += way
        self.reading, self._time, self._jumps = reading, time, 0
