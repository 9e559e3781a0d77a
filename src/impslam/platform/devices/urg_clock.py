"""When a scan was taken, on the host's time base.

A scan carries the sensor's clock at step 0, in whole ms of 24 bits. Three things are told apart:

- where the sensor's clock stands on the host's: asked for (TM) before scans stream, taken at the
  middle between request and answer;
- how long after its stamp a scan arrives at the least: most of a turn, the sensor's own processing,
  the transfer. It is measured against the first, over the first scans;
- how the sensor's clock drifts: followed by `DeviceClock` on the scans' arrivals less that delay.
"""

from __future__ import annotations

import math

from impslam.platform.devices.clock import DeviceClock, Unwrapper
from impslam.platform.devices.scip import STAMP_BITS

UNIT = 1e-3  # s, resolution of the sensor's clock
LEARNING = 20  # scans over which the least delay is learnt: 2 s, in which 100 ppm are 0.2 ms
SWIFT = 1e-3  # s, by which a TM answer may be slower than the swiftest and still count: a USB frame
HURRY = 0.5  # s by which scans may come in faster than they were taken, after a delay
STALL = 10.0  # s that scans may be held up; a tty holds two of them, TCP some hundred


class SweepTimes:
    """Places scans on the host's time base.

    Parameters
    ----------
    clock : follows the sensor's; it outlives this object, so that stamps never run backwards
    period : s from a scan to the next
    delay : s from step 0 to the arrival at the least, until it is known better

    Attributes
    ----------
    delay : s from step 0 of a scan to its arrival at the least
    """

    def __init__(self, clock: DeviceClock, period: float, delay: float) -> None:
        self._clock, self._period, self.delay = clock, period, delay
        self._unwrap = Unwrapper(STAMP_BITS, UNIT)
        self._last: tuple[int, float] | None = None  # raw stamp and arrival of what came last
        self._asked: list[tuple[float, float, float]] = []  # (round trip, device, host at middle)
        self._learning: list[tuple[float, float]] | None = []  # (device, arrived)
        self._streaming = False
        clock.restart()

    def synchronise(self, raw: int, sent: float, arrived: float) -> None:
        """Take the sensor's clock as it answered TM1, unless the answer cannot be."""
        if not self.is_plausible(raw, arrived):
            return
        self._asked.append((arrived - sent, self._unwrap(raw), 0.5 * (sent + arrived)))
        self._last = raw, arrived

    def is_plausible(self, raw: int, arrived: float) -> bool:
        """Tell whether a stamp fits the one before and the host's clock."""
        if self._last is None:
            return True
        before, heard = self._last
        elapsed, passed = ((raw - before) % (1 << STAMP_BITS)) * UNIT, arrived - heard
        least = 0.5 * self._period if self._streaming else 0.0
        return least <= elapsed <= passed + HURRY + self._clock.delay and passed < elapsed + STALL

    def place(self, raw: int, arrived: float) -> tuple[float, float]:
        """Return when a scan was at step 0: the sensor's clock, unwrapped, and the host's, in s."""
        self._settle()
        device = self._unwrap(raw)
        self._last, self._streaming = (raw, arrived), True
        if self._learning is None:
            self._clock.observe(device, arrived - self.delay)
        else:
            self._learn(device, arrived)
        return device, self._clock.to_host(device)

    def _settle(self) -> None:
        """Start the clock with the swiftest answers to TM1; without any, the first scan does it."""
        if not self._asked:
            return
        swiftest = min(self._asked)[0]
        device, host = min(
            ((device, host) for trip, device, host in self._asked if trip <= swiftest + SWIFT),
            key=lambda pair: pair[1] - pair[0],  # the clock is cut to ms: the least is the truest
        )
        self._clock.observe(device, host)
        self._asked.clear()

    def _learn(self, device: float, arrived: float) -> None:
        """Measure the least delay against the clock as TM told it."""
        assert self._learning is not None
        if math.isnan(self._clock.offset):
            self._learning = None  # nothing to measure against: the delay given is all there is
            self._clock.observe(device, arrived - self.delay)
            return
        self._learning.append((device, arrived))
        if len(self._learning) >= LEARNING:
            offset = self._clock.offset
            self.delay = min(arrived - device for device, arrived in self._learning) - offset
            for earlier, then in self._learning:
                self._clock.observe(earlier, then - self.delay)
            self._learning = None
