"""The panel to start, save and end the map."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from nicegui import html

from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, line, show, tagged, text
from impslam.platform.station.mapper_status import MapperStatus, scans_text
from impslam.platform.station.station import Station

STATE_TEXTS = {
    "off": "Not mapping",
    "compiling": "Compiling for this machine; once, up to a minute",
    "running": "Mapping",
    "failed": "Mapping has failed",
}


class MappingPanel:
    """Buttons to begin, save and end a map, and the status of the mapper."""

    def __init__(self, station: Station, viewer: Viewer) -> None:
        self._station, self._viewer = station, viewer
        self._may = viewer.session.may_drive
        self._saved_folder: Path | None = None
        with card("Map", "map", "mapping"):
            with line():
                self._start = button(
                    "Start mapping", "map-start", self._on_start, "primary", "add_location"
                )
                self._restart = button(
                    "New map", "map-new", self._on_restart, "plain", "restart_alt"
                )
                self._save = button("Save", "map-save", self._on_save, "plain", "save")
                self._end = button("End", "map-end", self._on_end, "plain", "stop")
                self._status = text("mapping", "", "soft")
            with line("saved") as self._saved_line:
                self._saved = text("map-saved", "", "soft")
                self._link = tagged(html.a("Download").classes("button plain"), "map-download")
            show(self._saved_line, False)

    def update(self, status: MapperStatus) -> None:
        """Show the present status of the mapper."""
        show(self._start, self._may and not status.on)
        show(self._restart, self._may and status.on)
        show(self._end, self._may and status.on)
        show(self._save, self._may and status.steps > 0 and not status.frozen)
        self._status.text = status_text(status)
        saved = self._saved_folder is not None and self._saved_folder == self._station.map_folder
        show(self._saved_line, saved)

    async def _on_start(self) -> None:
        await self._viewer.run(self._station.start_mapping)
        self.update(self._station.mapper.status())

    async def _on_restart(self) -> None:
        if await self._viewer.confirm(
            "Begin a new map? The current one stays under Maps.", "New map"
        ):
            await self._on_start()

    async def _on_end(self) -> None:
        self._status.text = "Saving …"
        await self._viewer.run(self._station.end_mapping)
        self.update(self._station.mapper.status())

    async def _on_save(self) -> None:
        self._status.text = "Saving …"
        saved: Path | None = await self._viewer.run(self._station.save_map)
        if saved is not None:
            self._saved_folder = saved
            self._saved.text = f"Saved on the robot in {saved}"
            self._link.props["href"] = f"/maps/{quote(saved.name)}.zip"
            self._link.props["download"] = f"{saved.name}.zip"
        self.update(self._station.mapper.status())


def notice(status: MapperStatus) -> str:
    """Return why the map does not follow the robot although nothing is wrong, "" if it does."""
    if status.state == "compiling":
        return STATE_TEXTS["compiling"]
    if status.state == "off" and status.steps:
        return "Mapping has ended; the robot is not tracked"
    return ""


def status_text(status: MapperStatus) -> str:
    """Return the state of the mapper, and what is wrong while it maps, or the number of scans."""
    if status.detail and status.state != "off":
        return f"{_state_text(status)}: {status.detail}"
    scans = f" · {scans_text(status.steps)}" if status.steps else ""
    return _state_text(status) + scans


def _state_text(status: MapperStatus) -> str:
    if not status.on or not status.name:
        return STATE_TEXTS[status.state]
    use = f"{'Localising in' if status.frozen else 'Going on with'} {status.name}"
    if status.state == "compiling":
        return f"{use} · {STATE_TEXTS['compiling']}"
    return use if status.placed else f"{use}, not found in it yet"
