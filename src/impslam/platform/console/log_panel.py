"""The panels to record, and of the logs on the robot's disk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nicegui import ui

from impslam.platform.console.feed import Feed
from impslam.platform.console.stored_panel import StoredPanel, moment
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, duration, line, show, size, tagged, text
from impslam.platform.station.log_store import StoredLog
from impslam.platform.station.recorder import RecordingStatus
from impslam.platform.station.station import Station


class RecordPanel:
    """Buttons to record and stop, and the status of the recording."""

    def __init__(self, station: Station, viewer: Viewer) -> None:
        self._station, self._viewer = station, viewer
        may = viewer.session.may_drive
        with card("Record", "radio_button_checked", "record"):
            with line():
                self._start = button("Record", "record", self._on_start, "primary", "circle")
                self._stop = button("Stop", "record-stop", self._on_stop, "danger", "stop")
                self._name = ui.element("input").props('placeholder="name (optional)" maxlength=40')
                self._name.props["aria-label"] = "Name of the log"
                tagged(self._name, "record-name").classes("field")
                self._name.on("input", self._on_name, js_handler="(e) => emit(e.target.value)")
                self._status = text("recording", "", "recording")
            self._error = text("record-error", "", "error-text")
        self._log_name = ""
        self._may = may

    def update(self, status: RecordingStatus) -> None:
        """Show the present status of the recorder."""
        show(self._start, self._may and not status.active)
        show(self._name, self._may and not status.active)
        show(self._stop, self._may and status.active)
        progress = f"{duration(status.seconds)} · {size(status.size)}" if status.active else ""
        self._status.text = progress or ("" if self._may else "Not recording")
        self._status.classes(
            add="on" if status.active else "", remove="" if status.active else "on"
        )
        self._error.text = status.error
        show(self._error, bool(status.error))

    def _on_name(self, event: Any) -> None:
        self._log_name = str(event.args)[:40].strip()

    async def _on_start(self) -> None:
        name = self._log_name or None
        await self._viewer.run(lambda: self._station.recorder.start(name))
        self.update(self._station.recorder.status())

    async def _on_stop(self) -> None:
        await self._viewer.run(self._station.recorder.stop)
        self.update(self._station.recorder.status())


class LogPanel(StoredPanel[StoredLog]):
    """The logs with size and date: download, delete; and the recycle bin."""

    def __init__(self, feed: Feed, station: Station, viewer: Viewer) -> None:
        empty_text = "No logs yet. Press Record to make one."
        super().__init__("log", "folder", empty_text, feed.logs, station.store, viewer)

    def facts(self, one: StoredLog) -> Sequence[str]:
        """Return date, size, duration and state."""
        return (
            moment(one.modified),
            "being recorded" if one.recording else size(one.size),
            duration(one.duration),
            "cut short" if one.cut and not one.recording else "",
        )

    def add_buttons(self, one: StoredLog) -> None:
        """Add the buttons of a log."""
        if not one.recording:
            self.add_download_button(one.name, one.name)
            self.add_delete_button(one.name)
