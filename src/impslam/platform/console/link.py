"""The link between page and robot: beats, alarms, and the age of commands."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from nicegui.element import Element

PERIOD = 0.2  # s between beats
BEAT_TIMEOUT = 1.0  # s without a beat until the page shows that the link is lost
CLOCK_TOLERANCE = 0.01  # s that a command may seem to come from the future: clocks are read in ms


class Link(Element, component="link.js"):
    """Sends beats to the page, which shows a lost link when they stop.

    A beat contains the robot's clock. Each command from the page contains the clock of the newest
    beat plus the time since then, so that the robot knows the travel time of beat and command
    together: a command that waited in the queue of a broken link must not move the robot.
    """

    def __init__(self, *, robot: bool) -> None:
        super().__init__()
        self._props["patience"] = BEAT_TIMEOUT
        self._props["robot"] = robot
        self._props["alarms"] = []

    def beat(self, picture: float) -> None:
        """Send a beat; `picture` is the stamp of the newest camera picture, 0 before the first."""
        self.run_method("beat", _milliseconds(), picture)

    def warn(self, alarms: Sequence[str]) -> None:
        """Show the present alarms of the robot."""
        if list(alarms) != self._props["alarms"]:
            self._props["alarms"] = list(alarms)


def age(stamp: object) -> float:
    """Return the age of a command with this stamp (ms), s; NaN if the stamp is invalid."""
    if not isinstance(stamp, int):
        return math.nan
    seconds = (_milliseconds() - stamp) / 1000
    return max(seconds, 0.0) if seconds > -CLOCK_TOLERANCE else math.nan


def _milliseconds() -> int:
    return round(1000 * time.monotonic())
