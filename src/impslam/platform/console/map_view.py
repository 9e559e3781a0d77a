"""The map on the page: one canvas, and frames at the rate at which it draws them."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from nicegui.element import Element
from nicegui.events import GenericEventArguments

from impslam.platform.console.encoding import SentState
from impslam.platform.console.feed import Feed

FOOTPRINT = (0.40, 0.30)  # m, length and width of the robot as drawn
MAX_COORDINATE = 1e6  # m from the origin of a map, larger than any map
PERIOD = 0.05  # s between checks for a new frame: half a sweep of the fastest lidar


Hint: TypeAlias = Callable[[float, float], Awaitable[None]]


class MapView(Element, component="map_view.js", esm={"impslam-map": "map"}):
    """Shows a map; a frame is sent only when the page has drawn the previous one.

    So no frame ever waits, and a slow or hidden page gets fewer, but always the newest frames.

    Parameters
    ----------
    feed : source of the frames
    hint : called with the position (m in map) of a click while the robot is being located in a map
    """

    def __init__(self, feed: Feed, hint: Hint | None = None) -> None:
        super().__init__()
        self._hint = hint
        self._props["asks"], self._props["notice"] = False, ""
        self._feed = feed
        self._sent_state = SentState()
        self._pending_version: int | None = None
        self._props["footprint"] = list(FOOTPRINT)
        self.on("drawn", self._on_drawn)
        if hint is not None:
            self.on("hint", self._on_hint)

    def offer(self) -> None:
        """Send a frame if there is a new one and the page is ready for it."""
        if self._pending_version is not None or not self.client.has_socket_connection:
            return
        frame = self._feed.frame(self._sent_state)
        if frame is not None:
            self._pending_version = frame["seq"]
            self.run_method("frame", frame)

    def accept_hints(self, wanted: bool) -> None:
        """Enable or disable hints by a click, if this page may give hints."""
        asks = wanted and self._hint is not None
        if asks != self._props["asks"]:
            self._props["asks"] = asks
            self.update()

    def show_notice(self, notice: str) -> None:
        """Show why the map does not follow the robot, instead of its pose and state; "" if it does."""
        if notice != self._props["notice"]:
            self._props["notice"] = notice
            self.update()

    async def _on_hint(self, event: GenericEventArguments) -> None:
        """Forward a valid position; ignore anything else."""
        match event.args:
            case [int() | float() as x, int() | float() as y] if math.hypot(x, y) < MAX_COORDINATE:
                assert self._hint is not None
                await self._hint(float(x), float(y))

    def _on_drawn(self, event: GenericEventArguments) -> None:
        """Handle the version that is drawn, and whether the page was visible all the time."""
        match event.args:
            case [int(version), bool(seen)] if version == self._pending_version:
                self._pending_version = None
                if seen:
                    self._feed.drawn(version)
                self.offer()
