"""The sensor of the emulated URG-04LX: motor, clock, laser, and measurements."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from impslam.platform.devices import scip
from impslam.platform.devices.scip_info import MeasurementParameters
from impslam.platform.virtual.base import Surroundings
from impslam.types import Ints

URG_04LX: Final = MeasurementParameters(
    "URG-04LX(Hokuyo Automatic Co.,Ltd.)", 20, 5600, 1024, 44, 725, 384, 600
)
LAST_STEP: Final = 768  # that may be requested; steps outside `first` to `last` return 19
NO_ECHO, TOO_NEAR, NOT_MEASURED = 0, 6, 19  # error codes


class UrgSensor:
    """The sensor without its protocol. Times are in s of the virtual robot.

    Attributes
    ----------
    laser_on : when the laser was switched on; inf: it is off
    slowed : relative reduction of the motor's speed, 0.01
    """

    def __init__(
        self, surroundings: Surroundings, drift: float, clock_start: int, turn: float
    ) -> None:
        self.parameters = URG_04LX
        self._surroundings, self._rate, self._turn = surroundings, 1.0 + drift, turn
        self.reset(0.0, clock_start)

    def reset(self, time: float, clock_start: int = 0) -> None:
        """Reset the clock (ms) and the motor, and switch the laser off."""
        self._begun, self._clock_start = time, clock_start
        self.laser_on, self.slowed = math.inf, 0

    @property
    def turn(self) -> float:
        """Time of a turn, s; the motor has the same drift as the clock."""
        return self._turn / self._rate * (1.0 + 0.01 * self.slowed)

    def clock(self, time: float) -> int:
        """Return its clock in ms."""
        elapsed = (time - self._begun) * self._rate
        # A microsecond covers the rounding of times computed from whole turns.
        return (self._clock_start + int(1e3 * elapsed + 1e-3)) % (1 << scip.STAMP_BITS)

    def begin(self, sweep: int) -> float:
        """Return the time of a sweep's step 0."""
        return self._begun + sweep * self.turn

    def end(self, sweep: int) -> float:
        """Return the time of a sweep's last measuring step."""
        return self.begin(sweep) + self.turn * self.parameters.last / self.parameters.steps

    def next_to_end(self, time: float) -> int:
        """Return the first sweep that ends after a time."""
        return max(0, math.floor((time - self.end(0)) / self.turn) + 1)

    def measured(self, sweep: int) -> bool:
        """Return whether the laser was on during a whole sweep (that has ended)."""
        return sweep >= 0 and self.begin(sweep) >= self.laser_on

    def values(self, sweep: int) -> Ints:
        """Return the values of steps 0 to 768 in a sweep, in mm or as error codes."""
        parameters = self.parameters
        begin = self.begin(sweep) + self.turn * parameters.first / parameters.steps
        read = np.rint(1e3 * self._surroundings.ranges(begin)).astype(np.int64)
        read[(read > 0) & (read < parameters.shortest)] = TOO_NEAR
        read[(read <= 0) | (read > parameters.longest)] = NO_ECHO
        values = np.full(LAST_STEP + 1, NOT_MEASURED, dtype=np.int64)
        values[parameters.first : parameters.last + 1] = read
        return values


def clustered(values: Ints, cluster: int) -> Ints:
    """Return the smallest distance of each `cluster` neighbours; the last group may be smaller.

    Error codes are only returned if a group has nothing else.
    """
    groups = np.arange(0, len(values), max(1, cluster))
    behind = np.int64(1 << 20)  # ranks the codes behind all distances
    ranked = np.where(values < scip.ERROR_CODES, values + behind, values)
    least = np.minimum.reduceat(ranked, groups)
    return np.asarray(np.where(least >= behind, least - behind, least), dtype=np.int64)
