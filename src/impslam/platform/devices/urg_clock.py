"""Times of scans on the host's time base.

A scan contains the sensor's clock at step 0, in ms with 24 bits. Three quantities are estimated:

- the offset of the sensor's clock: queried (TM) before scans stream, for the middle between request
  and answer;
- the minimum delay from the stamp of a scan to its arrival: most of a turn, processing and transfer.
  It is measured with that offset over the first scans;
- the drift of the sensor's clock: tracked by `DeviceClock` on arrivals minus that delay.
"""

from __future__ import annotations

import math

from impslam.platform.devices.clock import DeviceClock, Unwrapper
from impslam.platform.devices.scip import STAMP_BITS

UNIT = 1e-3  # s, resolution of the sensor's clock
LEARNING_SCANS = 20  # to measure the minimum delay: 2 s, in which 100 ppm are 0.2 ms
TRIP_TOLERANCE = 1e-3
"""s by which round trips of used TM answers may exceed the shortest: a USB frame."""
MAX_CATCH_UP = 0.5  # s by which scans may arrive faster than they were taken, after a delay
MAX_STALL = 10.0  # s that scans may be delayed; a tty buffers two of them, TCP some hundred


class SweepTimes:
    """Places scans on the host's time base.

    Parameters
    ----------
    clock : tracks the sensor's clock; it outlives this object, so that stamps never run backwards
    period : s from a scan to the next
    delay : initial minimum delay, s

    Attributes
    ----------
    delay : minimum delay from step 0 of a scan to its arrival, s
    """

    def __init__(self, clock: DeviceClock, period: float, delay: float) -> None:
        self._clock, self._period, self.delay = clock, period, delay
        self._unwrap = Unwrapper(STAMP_BITS, UNIT)
        self._last: tuple[int, float] | None = None  # last raw stamp and arrival
        self._answers: list[tuple[float, float, float]] = []  # (round trip, device, host at middle)
        self._learning: list[tuple[float, float]] | None = []  # (device, arrived)
        self._streaming = False
        clock.restart()

    def synchronise(self, raw: int, sent: float, arrived: float) -> None:
        """Add an answer to TM1, the sensor's clock, unless it is implausible."""
        if not self.is_plausible(raw, arrived):
            return
        self._answers.append((arrived - sent, self._unwrap(raw), 0.5 * (sent + arrived)))
        self._last = raw, arrived

    def is_plausible(self, raw: int, arrived: float) -> bool:
        """Return whether a stamp is consistent with the one before and the host's clock."""
        if self._last is None:
            return True
        before, last_arrival = self._last
        elapsed, passed = ((raw - before) % (1 << STAMP_BITS)) * UNIT, arrived - last_arrival
        least = 0.5 * self._period if self._streaming else 0.0
        return (
            least <= elapsed <= passed + MAX_CATCH_UP + self._clock.delay
            and passed < elapsed + MAX_STALL
        )

    def place(self, raw: int, arrived: float) -> tuple[float, float]:
        """Return the time of a scan's step 0 by the sensor's clock, unwrapped, and the host's, s."""
        self._start_clock()
        device = self._unwrap(raw)
        self._last, self._streaming = (raw, arrived), True
        if self._learning is None:
            self._clock.observe(device, arrived - self.delay)
        else:
            self._learn_delay(device, arrived)
        return device, self._clock.to_host(device)

    def _start_clock(self) -> None:
        """Start the clock with the fastest answers to TM1; without any, the first scan does."""
        if not self._answers:
            return
        shortest = min(self._answers)[0]
        device, host = min(
            (
                (device, host)
                for trip, device, host in self._answers
                if trip <= shortest + TRIP_TOLERANCE
            ),
            key=lambda pair: pair[1] - pair[0],  # the clock is truncated to ms: the least is best
        )
        self._clock.observe(device, host)
        self._answers.clear()

    def _learn_delay(self, device: float, arrived: float) -> None:
        """Measure the minimum delay against the clock by TM."""
        assert self._learning is not None
        if math.isnan(self._clock.offset):
            self._learning = None  # without TM, the initial delay is used
            self._clock.observe(device, arrived - self.delay)
            return
        self._learning.append((device, arrived))
        if len(self._learning) >= LEARNING_SCANS:
            offset = self._clock.offset
            self.delay = min(arrived - device for device, arrived in self._learning) - offset
            for earlier, then in self._learning:
                self._clock.observe(earlier, then - self.delay)
            self._learning = None
