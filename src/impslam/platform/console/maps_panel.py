"""The maps on the robot's disk."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from impslam.platform.console.feed import Feed
from impslam.platform.console.stored_panel import StoredPanel, moment
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, size
from impslam.platform.station.map_store import StoredMap
from impslam.platform.station.station import Station


class MapsPanel(StoredPanel[StoredMap]):
    """The maps with size and date: download, delete; and the recycle bin."""

    def __init__(self, feed: Feed, station: Station, viewer: Viewer) -> None:
        none = "No maps yet. Start mapping to make one; it is saved each minute."
        self._station = station
        super().__init__("map", "map", none, feed.maps, station.maps, viewer)

    def facts(self, one: StoredMap) -> Sequence[str]:
        """Return date, size, number of scans and state."""
        return (
            moment(one.modified),
            size(one.size),
            f"{one.scans} scans" if one.scans else "",
            "being made" if one.mapping else "",
            "with report" if one.report else "",
            "damaged" if one.damage else "",
        )

    def acts(self, one: StoredMap) -> None:
        """Make the buttons."""
        self.download(one.name, f"{one.name}.zip")
        if one.mapping:
            return
        if self._viewer.session.may_drive and not one.damage:
            go_on = self._starter(one.name, frozen=False)
            button(f"Go on with {one.name}", "go-on", go_on, "quiet", "add_location")
            localise = self._starter(one.name, frozen=True)
            button(f"Localise in {one.name}", "localise", localise, "quiet", "my_location")
        self.deleter(one.name)

    def _starter(self, name: str, *, frozen: bool) -> Callable[[], Awaitable[None]]:
        act = "Localise" if frozen else "Go on"
        question = (
            f"Localise in {name}? It stays as it is."
            if frozen
            else f"Go on with {name}? It stays, and a new map grows from it."
        )
        question += " Where the robot is in it is found while it drives."

        async def start() -> None:
            if await self._viewer.confirm(f"{question} The present map stays under Maps.", act):
                await self._viewer.run(lambda: self._station.go_on(name, frozen=frozen))
                await self.anew()

        return start
