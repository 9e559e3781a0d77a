"""The map on the page: one canvas, and frames that come as fast as it draws them."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from nicegui.element import Element
from nicegui.events import GenericEventArguments

from impslam.platform.console.encoding import Known
from impslam.platform.console.feed import Feed

FARTHEST = 1e6  # m from the origin of the map, beyond any
PERIOD = 0.05  # s between looks for something new: half a sweep of the fastest lidar


Hint: TypeAlias = Callable[[float, float], Awaitable[None]]


class MapView(Element, component="map_view.js", esm={"impslam-map": "map"}):
    """Shows a map. A frame is sent when the page has drawn the one before, so that none ever waits.

    A page that is slow, or hidden, so sees fewer frames, and each as new as can be.

    Parameters
    ----------
    feed : where the frames come from
    hint : called with x and y (m in map) where who may drive clicks, while the robot is sought in a map
    footprint : m, length and width of the robot as it is drawn
    """

    def __init__(
        self,
        feed: Feed,
        hint: Hint | None = None,
        footprint: tuple[float, float] = (0.40, 0.30),
    ) -> None:
        super().__init__()
        self._hint = hint
        self._props["asks"] = False
        self._feed = feed
        self._known = Known()
        self._awaited: int | None = None
        self._props["footprint"] = list(footprint)
        self.on("drawn", self._on_drawn)
        if hint is not None:
            self.on("hint", self._on_hint)

    def offer(self) -> None:
        """Send what is new, if the page can take it."""
        if self._awaited is not None or not self.client.has_socket_connection:
            return
        frame = self._feed.frame(self._known)
        if frame is not None:
            self._awaited = frame["seq"]
            self.run_method("frame", frame)

    def ask(self, wanted: bool) -> None:
        """Say that a click tells where the robot is, or not; that is for who may tell."""
        asks = wanted and self._hint is not None
        if asks != self._props["asks"]:
            self._props["asks"] = asks
            self.update()

    async def _on_hint(self, event: GenericEventArguments) -> None:
        """Pass on a place; what is no place is ignored."""
        match event.args:
            case [int() | float() as x, int() | float() as y] if math.hypot(x, y) < FARTHEST:
                assert self._hint is not None
                await self._hint(float(x), float(y))

    def _on_drawn(self, event: GenericEventArguments) -> None:
        """Take the number of what is drawn, and whether the page was in sight all the while."""
        match event.args:
            case [int(version), bool(seen)] if version == self._awaited:
                self._awaited = None
                if seen:
                    self._feed.drawn(version)
                self.offer()
