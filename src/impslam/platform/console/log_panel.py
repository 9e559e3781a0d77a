"""Recording, and the logs on the robot's disk."""

from __future__ import annotations

import time
from typing import Any
from urllib.parse import quote

from nicegui import html, run, ui
from nicegui.element import Element

from impslam.platform.console.feed import Feed
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, duration, line, show, size, tagged, text
from impslam.platform.station.recorder import RecordingStatus
from impslam.platform.station.station import Station
from impslam.platform.station.store import BinnedLog, StoredLog

MOST = 100  # logs in the list; more would make the page slow, and nobody reads them


class RecordPanel:
    """Record and stop."""

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
                self._said = text("recording", "", "recording")
            self._error = text("record-error", "", "error-text")
        self._wanted = ""
        self._may = may

    def update(self, status: RecordingStatus) -> None:
        """Show the recorder as it is by now."""
        show(self._start, self._may and not status.active)
        show(self._name, self._may and not status.active)
        show(self._stop, self._may and status.active)
        told = f"{duration(status.seconds)} · {size(status.size)}" if status.active else ""
        self._said.text = told or ("" if self._may else "Not recording")
        self._said.classes(add="on" if status.active else "", remove="" if status.active else "on")
        self._error.text = status.error
        show(self._error, bool(status.error))

    def _on_name(self, event: Any) -> None:
        self._wanted = str(event.args)[:40].strip()

    async def _on_start(self) -> None:
        name = self._wanted or None
        await self._viewer.run(lambda: self._station.recorder.start(name))
        self.update(self._station.recorder.status())

    async def _on_stop(self) -> None:
        await self._viewer.run(self._station.recorder.stop)
        self.update(self._station.recorder.status())


class LogPanel:
    """The logs with size and date: download, delete; and the recycle bin."""

    def __init__(self, feed: Feed, station: Station, viewer: Viewer) -> None:
        self._feed, self._station, self._viewer = feed, station, viewer
        self._looking = False
        self._shown: list[StoredLog] | None = None
        self._binned: list[BinnedLog] | None = None
        with card("Logs", "folder", "logs"):
            self._list = tagged(ui.element("div").classes("list"), "logs")
            with html.details().classes("fold") as self._bin:
                with html.summary():
                    self._summary = text("bin-summary", "Recycle bin")
                self._bin_list = tagged(ui.element("div").classes("list"), "bin")

    async def update(self) -> None:
        """Show the logs as they are by now; the disk is looked at in a thread."""
        if self._looking:  # a disk that hangs must not be asked again and again
            return
        self._looking = True
        try:
            found = await run.io_bound(self._feed.stored)
        finally:
            self._looking = False
        if found is not None and not self._viewer.client.is_deleted:
            self._show(*found)

    async def _anew(self) -> None:
        self._feed.stored.expire()
        await self.update()

    def _show(self, logs: list[StoredLog], binned: list[BinnedLog]) -> None:
        if logs != self._shown:
            self._shown = logs
            self._fill()
        if binned != self._binned:
            self._binned = binned
            self._fill_bin()

    def _fill(self) -> None:
        self._list.clear()
        with self._list:
            for one in (self._shown or [])[:MOST]:
                self._row(one)
            if not self._shown:
                ui.label("No logs yet. Press Record to make one.").classes("soft")
            elif len(self._shown) > MOST:
                ui.label(f"and {len(self._shown) - MOST} older ones").classes("soft")

    def _row(self, log: StoredLog) -> None:
        facts = [
            time.strftime("%Y-%m-%d %H:%M", time.localtime(log.modified)),
            "being recorded" if log.recording else size(log.size),
            duration(log.duration),
            "cut short" if log.cut and not log.recording else "",
        ]
        with _item(log.name, facts, "log"):
            if not log.recording:
                self._download(log.name)
            if self._viewer.session.may_drive and not log.recording:
                button(
                    f"Delete {log.name}",
                    "delete",
                    lambda: self._delete(log.name),
                    "quiet",
                    "delete",
                )

    @staticmethod
    def _download(name: str) -> None:
        link: Element = html.a(href=f"/logs/{quote(name)}", download=name)
        link.classes("button quiet").props["aria-label"] = f"Download {name}"
        link.props["title"] = "Download"
        with tagged(link, "download"):
            html.i("download").classes("q-icon material-icons notranslate")

    def _fill_bin(self) -> None:
        binned, may = self._binned or [], self._viewer.session.may_drive
        self._summary.text = f"Recycle bin ({len(binned)})" if binned else "Recycle bin is empty"
        self._bin_list.clear()
        with self._bin_list:
            for one in binned[:MOST]:
                moment = time.strftime("%Y-%m-%d %H:%M", time.localtime(one.deleted))
                with _item(one.original, [f"deleted {moment}", size(one.size)], "binned"):
                    if may:
                        act = self._restorer(one.name)
                        button("Restore", "restore", act, "quiet", "restore_from_trash")
            if binned and may:
                button("Empty the recycle bin", "purge", self._purge, "danger", "delete_forever")

    def _restorer(self, name: str) -> Any:
        async def restore() -> None:
            await self._viewer.run(lambda: self._station.store.restore(name))
            await self._anew()

        return restore

    async def _delete(self, name: str) -> None:
        if await self._viewer.confirm(f"Move {name} to the recycle bin?", "Delete"):
            await self._viewer.run(lambda: self._station.store.delete(name))
            await self._anew()

    async def _purge(self) -> None:
        if await self._viewer.confirm(
            "Delete everything in the recycle bin for good?", "Delete for good"
        ):
            await self._viewer.run(self._station.store.purge)
            await self._anew()


def _item(name: str, facts: list[str], kind: str) -> Element:
    """Return a row for what has a name; buttons go into it."""
    row = tagged(ui.element("div").classes("item"), kind)
    row.props["data-name"] = name
    with row, ui.element("div").classes("what"):
        ui.label(name).classes("name")
        ui.label(" · ".join(filter(None, facts))).classes("soft")
    return row
