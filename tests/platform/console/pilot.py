"""A pilot that drives along waypoints with the joystick of the page, using only what the page shows."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from playwright.sync_api import Locator, Page

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
NEAR = 0.15  # m: a waypoint is reached
SPIN = 0.7  # rad: for a larger deviation of the heading, turn on the spot
PERIOD = 0.08  # s between readings of the map

ARENA = [
    (1.2, 0.02), (2.4, 0.0762), (4.0, 0.0762), (5.0, 0.10), (5.4, 0.45), (5.1, 0.75), (4.6, 0.85),
    (4.15, 1.15), (3.3, 1.22), (2.7, 1.15), (2.3, 0.75), (1.6, 0.55), (0.8, 0.6), (0.35, 0.35),
]  # fmt: skip
"""m, a round through the thesis's arena, in the frame of a robot that starts at its origin."""


class Pilot:
    """Holds the joystick with the mouse. The page must be open and its robot mapping."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._map, self._pad = page.get_by_test_id("map"), page.get_by_test_id("pad")

    def pose(self) -> tuple[float, float, float]:
        """Return x, y and heading as the map shows them, m and rad."""
        x, y, heading = self._map.evaluate("e => [e.dataset.x, e.dataset.y, e.dataset.heading]")
        return float(x), float(y), float(heading)

    def drive(self, waypoints: Sequence[tuple[float, float]], patience: float = 180.0) -> None:
        """Drive along waypoints (m in map), let the joystick go, and stand."""
        end = time.monotonic() + patience
        self._grip()
        for x, y in waypoints:
            while (gap := self._steer(x, y)) > NEAR:
                assert time.monotonic() < end, f"stuck {gap:.2f} m before {x}, {y}: {self.pose()}"
                time.sleep(PERIOD)
        self._page.mouse.up()

    def _grip(self) -> None:
        self._pad.scroll_into_view_if_needed()
        self._middle, self._radius = _middle(self._pad)
        self._page.mouse.move(*self._middle)
        self._page.mouse.down()

    def _steer(self, x: float, y: float) -> float:
        """Point the joystick towards a waypoint; return its distance, m."""
        here_x, here_y, heading = self.pose()
        bearing = math.atan2(y - here_y, x - here_x) - heading
        bearing = math.remainder(bearing, 2 * math.pi)
        forward = 0.0 if abs(bearing) > SPIN else 0.95 * math.cos(bearing) ** 4
        left = max(-0.7, min(0.7, 1.2 * bearing))
        size = max(1.0, math.hypot(forward, left))
        self._page.mouse.move(
            self._middle[0] - self._radius * left / size,
            self._middle[1] - self._radius * forward / size,
        )
        return math.hypot(x - here_x, y - here_y)


def _middle(pad: Locator) -> tuple[tuple[float, float], float]:
    """Return the pad's middle and the radius at which the joystick is fully out, in px."""
    box = pad.bounding_box()
    assert box is not None, "the joystick is not to be seen"
    return (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), 0.36 * box["width"]
