"""The drive pad: joystick, keys and speed, and the commands that it sends."""

from __future__ import annotations

import math
from typing import Any

from nicegui.element import Element

from impslam.platform.console.link import age


class DrivePad(Element, component="drive_pad.js"):
    """Joystick, keys and speed; sends commands as fractions of the limits, ten times a second."""

    def __init__(self, limits: tuple[float, float]) -> None:
        super().__init__()
        self._props["limits"] = list(limits)
        self._props["driving"] = False

    def enable(self, *, driving: bool) -> None:
        """Let the pad send commands, or stop it."""
        if driving != self._props["driving"]:
            self._props["driving"] = driving


def pad_command(args: Any) -> tuple[float, float, float] | None:
    """Return the fractions forward and left in [-1, 1] and the age in s, None if malformed."""
    if not isinstance(args, list) or len(args) != 3 or not math.isfinite(late := age(args[2])):
        return None
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in args[:2]):
        return None
    forward, left = (max(-1.0, min(1.0, float(value))) for value in args[:2])
    return forward, left, late
