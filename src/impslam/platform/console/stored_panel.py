"""A list of logs or maps on the robot's disk, with a recycle bin."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Generic, Protocol, TypeVar
from urllib.parse import quote

from nicegui import html, run, ui
from nicegui.element import Element

from impslam.platform.console.feed import Cached
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, size, tagged, text
from impslam.platform.station.store import DeletedEntry

MAX_ROWS = 100  # of a list; more would make the page slow


class Stored(Protocol):
    """An entry on the disk."""

    @property
    def name(self) -> str:
        """Its name on the disk."""


class Store(Protocol):
    """Deletes and restores entries."""

    def delete(self, name: str) -> None:
        """Move an entry to the recycle bin."""

    def restore(self, name: str) -> object:
        """Move an entry back from the recycle bin."""

    def purge(self) -> None:
        """Empty the recycle bin."""


S = TypeVar("S", bound=Stored)


class StoredPanel(Generic[S]):
    """A list of stored entries, newest first, and their recycle bin.

    Parameters
    ----------
    word : word for an entry, as in "log"; part of test ids
    icon : icon of the card
    empty_text : text of an empty list
    read : returns the entries and the contents of the recycle bin; called in a thread
    """

    def __init__(
        self,
        word: str,
        icon: str,
        empty_text: str,
        read: Cached[tuple[list[S], list[DeletedEntry]]],
        store: Store,
        viewer: Viewer,
    ) -> None:
        self._word, self._empty_text, self._read, self._store = word, empty_text, read, store
        self._viewer = viewer
        self._reading = False
        self._rows: list[tuple[str, Sequence[str]]] | None = None
        self._binned: list[DeletedEntry] | None = None
        with card(f"{word.capitalize()}s", icon, f"{word}s"):
            self._list = tagged(ui.element("div").classes("list"), f"{word}s")
            with html.details().classes("fold"):
                with html.summary():
                    self._summary = text(f"{word}-bin-summary", "Recycle bin")
                self._bin_list = tagged(ui.element("div").classes("list"), f"{word}-bin")

    async def update(self) -> None:
        """Show the present entries; the disk is read in a thread."""
        if self._reading:  # do not pile up threads if the disk hangs
            return
        self._reading = True
        try:
            found = await run.io_bound(self._read)
        finally:
            self._reading = False
        if found is not None and not self._viewer.client.is_deleted:
            self._show(*found)

    def facts(self, one: S) -> Sequence[str]:
        """Return the facts shown below the name of an entry; empty ones are left out."""
        raise NotImplementedError

    def add_buttons(self, one: S) -> None:
        """Add the buttons of an entry, which depend on its name and facts only."""
        raise NotImplementedError

    def add_download_button(self, name: str, file: str) -> None:
        """Add a button that downloads a file of an entry."""
        link: Element = html.a(href=f"/{self._word}s/{quote(file)}", download=file)
        link.classes("button quiet").props["aria-label"] = f"Download {name}"
        link.props["title"] = "Download"
        with tagged(link, "download"):
            html.i("download").classes("q-icon material-icons notranslate")

    def add_delete_button(self, name: str) -> None:
        """Add a button that deletes an entry, if the viewer may."""

        async def delete() -> None:
            if await self._viewer.confirm(f"Move {name} to the recycle bin?", "Delete"):
                await self._viewer.run(lambda: self._store.delete(name))
                await self.refresh()

        if self._viewer.session.may_drive:
            button(f"Delete {name}", "delete", delete, "quiet", "delete")

    async def refresh(self) -> None:
        """Read the disk again."""
        self._read.expire()
        await self.update()

    def _show(self, stored: list[S], binned: list[DeletedEntry]) -> None:
        # Only what is visible counts: a log that grows must not replace buttons while they are pressed.
        rows = [(one.name, self.facts(one)) for one in stored]
        if rows != self._rows:
            self._rows = rows
            self._fill(stored)
        if binned != self._binned:
            self._binned = binned
            self._fill_bin()

    def _fill(self, stored: list[S]) -> None:
        self._list.clear()
        with self._list:
            for one in stored[:MAX_ROWS]:
                with _item(one.name, self.facts(one), f"stored-{self._word}"):
                    self.add_buttons(one)
            if not stored:
                ui.label(self._empty_text).classes("soft")
            elif len(stored) > MAX_ROWS:
                ui.label(f"and {len(stored) - MAX_ROWS} older ones").classes("soft")

    def _fill_bin(self) -> None:
        binned, may = self._binned or [], self._viewer.session.may_drive
        self._summary.text = f"Recycle bin ({len(binned)})" if binned else "Recycle bin is empty"
        self._bin_list.clear()
        with self._bin_list:
            for one in binned[:MAX_ROWS]:
                facts = [f"deleted {moment(one.deleted)}", size(one.size)]
                with _item(one.original, facts, "binned"):
                    if may:
                        act = self._restore_action(one.name)
                        button("Restore", "restore", act, "quiet", "restore_from_trash")
            if binned and may:
                button("Empty the recycle bin", "purge", self._purge, "danger", "delete_forever")

    def _restore_action(self, name: str) -> Any:
        async def restore() -> None:
            await self._viewer.run(lambda: self._store.restore(name))
            await self.refresh()

        return restore

    async def _purge(self) -> None:
        if await self._viewer.confirm(
            f"Delete all {self._word}s in the recycle bin for good?", "Delete for good"
        ):
            await self._viewer.run(self._store.purge)
            await self.refresh()


def moment(seconds: float) -> str:
    """Return a time in s since 1970 as date and time of day."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _item(name: str, facts: Sequence[str], kind: str) -> Element:
    """Return a row with a name and facts, to add buttons to."""
    row = tagged(ui.element("div").classes("item"), kind)
    row.props["data-name"] = name
    with row, ui.element("div").classes("what"):
        ui.label(name).classes("name")
        ui.label(" · ".join(filter(None, facts))).classes("soft")
    return row
