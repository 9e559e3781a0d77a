"""The link between page and robot: beats, what is wrong with the robot, and its end."""

from __future__ import annotations

import time
from collections.abc import Sequence

from nicegui.element import Element

PERIOD = 0.2  # s between beats
PATIENCE = 1.0  # s without a beat after which the page says that the link is lost


class Link(Element, component="link.js"):
    """Sends beats, by which the page knows that the robot lives; without them it says so by itself.

    Each command from the page brings the newest beat back. A command that brings an old one has
    been on its way for too long, in a queue that a broken link filled: it must not move the robot.
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


def fresh(beat: object) -> bool:
    """Return whether a beat that came back from a page was sent less than `PATIENCE` ago."""
    return isinstance(beat, int) and 0 <= _milliseconds() - beat <= 1000 * PATIENCE


def _milliseconds() -> int:
    return round(1000 * time.monotonic())
