"""The map on the page: one canvas, and frames that come as fast as it draws them."""

from __future__ import annotations

from nicegui.element import Element
from nicegui.events import GenericEventArguments

from impslam.platform.console.encoding import Known
from impslam.platform.console.feed import Feed

PERIOD = 0.05  # s between looks for something new: half a sweep of the fastest lidar


class MapView(Element, component="map_view.js", esm={"impslam-map": "map"}):
    """Shows a map. A frame is sent when the page has drawn the one before, so that none ever waits.

    A page that is slow, or hidden, so sees fewer frames, and each as new as can be.

    Parameters
    ----------
    feed : where the frames come from
    footprint : m, length and width of the robot as it is drawn
    """

    def __init__(self, feed: Feed, footprint: tuple[float, float] = (0.40, 0.30)) -> None:
        super().__init__()
        self._feed = feed
        self._known = Known()
        self._awaited: int | None = None
        self._props["footprint"] = list(footprint)
        self.on("drawn", self._on_drawn)

    def offer(self) -> None:
        """Send what is new, if the page can take it."""
        if self._awaited is not None or not self.client.has_socket_connection:
            return
        frame = self._feed.frame(self._known)
        if frame is not None:
            self._awaited = frame["seq"]
            self.run_method("frame", frame)

    def _on_drawn(self, event: GenericEventArguments) -> None:
        """Take the number of what is drawn, and whether the page was in sight all the while."""
        match event.args:
            case [int(version), bool(seen)] if version == self._awaited:
                self._awaited = None
                if seen:
                    self._feed.drawn(version)
                self.offer()
