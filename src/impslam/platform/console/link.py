"""The link between page and robot: beats, what is wrong with the robot, and its end."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from nicegui.element import Element

PERIOD = 0.2  # s between beats
PATIENCE = 1.0  # s without a beat after which the page says that the link is lost
ROUNDING = 0.01  # s that a command may seem to come from the future: clocks are read in ms


class Link(Element, component="link.js"):
    """Sends beats, by which the page knows that the robot lives; without them it says so by itself.

    A beat carries the robot's clock. Each command from the page carries that clock as well, gone on
    since the newest beat came, so that the robot knows how long the beat and the command together
    were on their way: what waited in a queue that a broken link filled must not move it.
    """

    def __init__(self, *, robot: bool) -> None:
        super().__init__()
        self._props["patience"] = PATIENCE
        self._props["robot"] = robot
        self._props["alarms"] = []

    def beat(self, picture: float) -> None:
        """Send a beat; `picture` is the stamp of the newest camera picture, 0 before the first."""
        self.run_method("beat", _milliseconds(), picture)

    def warn(self, alarms: Sequence[str]) -> None:
        """Show what is wrong with the robot, for as long as it is."""
        if list(alarms) != self._props["alarms"]:
            self._props["alarms"] = list(alarms)


def age(stamp: object) -> float:
    """Return for how many s a command with this stamp (ms) has been under way; NaN if it is none."""
    if not isinstance(stamp, int):
        return math.nan
    seconds = (_milliseconds() - stamp) / 1000
    return max(seconds, 0.0) if seconds > -ROUNDING else math.nan


def _milliseconds() -> int:
    return round(1000 * time.monotonic())
