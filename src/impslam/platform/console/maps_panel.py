"""The panel of the maps on the robot's disk."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

from impslam.platform.console.feed import Feed
from impslam.platform.console.stored_panel import StoredPanel, moment
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, size
from impslam.platform.station.map_store import StoredMap
from impslam.platform.station.mapper_status import scans_text
from impslam.platform.station.station import Station


class MapsPanel(StoredPanel[StoredMap]):
    """The maps with size and date: download, delete; and the recycle bin."""

    def __init__(self, feed: Feed, station: Station, viewer: Viewer) -> None:
        empty_text = "No maps yet. Start mapping to make one; it is saved each minute."
        self._station = station
        super().__init__("map", "map", empty_text, feed.maps, station.maps, viewer)

    def facts(self, one: StoredMap) -> Sequence[str]:
        """Return date, size, number of scans and state."""
        return (
            moment(one.modified),
            size(one.size),
            scans_text(one.scans) if one.scans else "",
            "in progress" if one.mapping else "",
            "with report" if one.report else "",
            "damaged" if one.damage else "",
        )

    def add_buttons(self, one: StoredMap) -> None:
        """Add the buttons of a map."""
        self.add_download_button(one.name, f"{one.name}.zip")
        if one.mapping:
            return
        if self._viewer.session.may_drive and not one.damage:
            continue_ = self._start_action(one.name, frozen=False)
            button(f"Continue {one.name}", "continue", continue_, "quiet", "add_location")
            localise = self._start_action(one.name, frozen=True)
            button(f"Localise in {one.name}", "localise", localise, "quiet", "my_location")
        self.add_delete_button(one.name)

    def _start_action(self, name: str, *, frozen: bool) -> Callable[[], Awaitable[None]]:
        if frozen:
            act, question = "Localise", f"Localise in {name}? The map does not change."
        else:
            act = "Continue"
            question = f"Continue {name}? A new map begins as a copy of it."
        question += " The robot finds its place after some 10 m of driving."

        async def start() -> None:
            if await self._viewer.confirm(f"{question} The current map is kept under Maps.", act):
                await self._viewer.run(lambda: self._station.continue_map(name, frozen=frozen))
                await self.refresh()

        return start
