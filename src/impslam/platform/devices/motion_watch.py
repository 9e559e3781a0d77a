"""Notice that a robot stands although it is driven: it is blocked, or its motors have no power."""

from __future__ import annotations

import math

MIN_TURN = 0.1
"""rad: a wheel that turned by less stands; ten times the noise of the encoders, 6 mm of a 5 inch wheel."""
MIN_DISTANCE = 0.1
"""m that was commanded meanwhile: then the robot has moved by less than a fifteenth of it."""
MIN_TIME = 1.0
"""s for which the wheels stand: motors need some tenths of a second to start."""


class MotionWatch:
    """Compares commands with the wheels' encoders.

    Both wheels must stand: in a curve about one wheel, that one stands although its side is driven, because
    driven wheels that slide across need a larger difference than rolling ones.

    Attributes
    ----------
    stands : whether the robot stands although it is driven
    """

    def __init__(self) -> None:
        self.stands = False
        self._command = 0.0
        self._angles = (math.nan, math.nan)  # where the wheels began to stand; NaN before the first
        self._begin = self._newest = 0.0
        self._distance = 0.0

    def command(self, left: float, right: float) -> None:
        """Take the newest command, m/s; from any thread."""
        self._command = max(abs(left), abs(right))

    def update(self, angles: tuple[float, float], moment: float, *, driven: bool) -> bool:
        """Update with the wheels' angles, rad, at a time, s; return whether the robot begins to stand.

        `driven` is whether the motors follow commands: they do not during an emergency stop.
        """
        (left, right), (left_before, right_before) = angles, self._angles
        stand = abs(left - left_before) <= MIN_TURN and abs(right - right_before) <= MIN_TURN
        if not stand or not driven or self._command == 0.0:
            self._angles, self._begin, self._distance = angles, moment, 0.0
        else:
            self._distance += self._command * (moment - self._newest)
        before, self._newest = self.stands, moment
        self.stands = self._distance >= MIN_DISTANCE and moment - self._begin >= MIN_TIME
        return self.stands and not before
