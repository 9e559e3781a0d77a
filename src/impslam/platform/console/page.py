"""The page: map, drive, record, health, camera and logs of a robot; or the replay of a log."""

from __future__ import annotations

from pathlib import Path

from fastapi import Request, Response
from nicegui import app, html, ui

from impslam.platform.console import link, map_view
from impslam.platform.console.feed import Feed
from impslam.platform.console.header import Header
from impslam.platform.console.link import Link
from impslam.platform.console.map_view import Hint, MapView
from impslam.platform.console.mapping_panel import notice
from impslam.platform.console.model import Model
from impslam.platform.console.replay_panel import ReplayPanel
from impslam.platform.console.robot_panels import RobotPanels
from impslam.platform.console.viewer import Viewer
from impslam.platform.station.station import Station
from impslam.types import Array

STYLE = Path(__file__).with_name("console.css")
SLOW_PERIOD = 1.0  # s between updates of texts
RELOAD_DELAY = 2.0  # s from the end of a session until the page reloads
_feeds: list[Feed] = []


def build(model: Model) -> None:
    """Register the page at `/`, and the picture of the grid that it requests."""
    feed = Feed(model)
    _feeds[:] = [feed]

    @ui.page("/", title=model.title, dark=None, language="en-US")
    def index(request: Request) -> None:
        Page(feed, Viewer(request.state.session, ui.context.client))

    @app.api_route("/grid.png", methods=["GET", "HEAD"])  # HEAD: by a page that has lost its link
    def grid() -> Response:
        picture = model.view.snapshot().grid
        headers = {"Cache-Control": "no-store"}
        if picture is None:
            return Response("no picture yet\n", 404, headers, "text/plain")
        return Response(picture.png, 200, headers, "image/png")


def latencies() -> Array:
    """Return (n,) s from the arrival of a scan until it is drawn on a page, the newest thousand."""
    return _feeds[0].latencies()


class Page:
    """One open page: its parts, and the timers that keep them up to date."""

    def __init__(self, feed: Feed, viewer: Viewer) -> None:
        self._feed, self._viewer, model = feed, viewer, feed.model
        self._gone = False
        self._panels: RobotPanels | ReplayPanel | None = None
        ui.add_css(STYLE)
        with html.div().classes("console"):
            self._build(model)
        self._update_slow()
        ui.timer(map_view.PERIOD, self._map.offer)
        ui.timer(link.PERIOD, self._beat)
        ui.timer(SLOW_PERIOD, self._update_slow)
        viewer.client.on_disconnect(self._leave)

    def _build(self, model: Model) -> None:
        self._header = Header(model, self._viewer)
        self._link = Link(robot=model.station is not None)
        with html.main():
            self._map = MapView(self._feed, self._hint_for(model.station))
            if model.station is not None:
                self._panels = RobotPanels(self._feed, model.station, self._viewer, self._header)
            elif model.player is not None:
                with html.aside().classes("side replay"):
                    self._panels = ReplayPanel(model.player, self._viewer)

    def _hint_for(self, station: Station | None) -> Hint | None:
        """Return the handler of clicks while the robot is being located, None for watchers."""
        if station is None or not self._viewer.session.may_drive:
            return None

        async def hint(x: float, y: float) -> None:
            await self._viewer.run(lambda: station.hint(x, y))

        return hint

    def _beat(self) -> None:
        """Send the heartbeat of the link, and update the state that cannot wait."""
        if not self._viewer.session.alive():
            self._end()
            return
        if not self._viewer.client.has_socket_connection:
            return
        station = self._feed.model.station
        picture = station.picture if station is not None else None
        self._link.beat(picture.stamp if picture is not None else 0.0)
        if isinstance(self._panels, ReplayPanel):
            self._panels.update()
        elif self._panels is not None:
            self._panels.fast()

    def _update_slow(self) -> None:
        if isinstance(self._panels, RobotPanels):
            self._link.warn(self._panels.slow())
            mapping = self._feed.health().mapping
            self._map.show_notice(notice(mapping))
            self._map.accept_hints(mapping.on and bool(mapping.name))

    def _end(self) -> None:
        """Reload the page, as the session has ended; the guard then requires a login.

        The browser waits for `RELOAD_DELAY`: after a logout, it is on its way to the page for that.
        """
        if not self._gone:
            self._gone = True
            self._leave()
            ui.run_javascript(f"setTimeout(() => location.reload(), {1e3 * RELOAD_DELAY:.0f})")

    def _leave(self) -> None:
        if isinstance(self._panels, RobotPanels):
            self._panels.leave()
