"""The maps on the robot's disk."""

from __future__ import annotations

from collections.abc import Sequence

from impslam.platform.console.feed import Feed
from impslam.platform.console.stored_panel import StoredPanel, moment
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import size
from impslam.platform.station.map_store import StoredMap
from impslam.platform.station.station import Station


class MapsPanel(StoredPanel[StoredMap]):
    """The maps with size and date: download, delete; and the recycle bin."""

    def __init__(self, feed: Feed, station: Station, viewer: Viewer) -> None:
        none = "No maps yet. Start mapping to make one; it is saved each minute."
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
        if not one.mapping:
            self.deleter(one.name)
