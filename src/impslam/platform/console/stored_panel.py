"""What lies on the robot's disk, as a list with a recycle bin: logs, maps."""

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
from impslam.platform.station.shelf import Binned

MOST = 100  # rows in the list; more would make the page slow, and nobody reads them


class Stored(Protocol):
    """One thing on the disk."""

    @property
    def name(self) -> str:
        """Its name there."""


class Store(Protocol):
    """Where it is deleted and comes back."""

    def delete(self, name: str) -> None:
        """Move it to the recycle bin."""

    def restore(self, name: str) -> object:
        """Take it out of the recycle bin."""

    def purge(self) -> None:
        """Empty the recycle bin."""


S = TypeVar("S", bound=Stored)


class StoredPanel(Generic[S]):
    """A list of what is stored, newest first, and its recycle bin.

    Parameters
    ----------
    word : what is stored, as in "log"; test ids are made of it
    icon : of the card
    none : what is said while there is none
    look : returns what is stored and what is in the recycle bin; it is called in a thread
    """

    def __init__(  # each differs between logs and maps
        self,
        word: str,
        icon: str,
        none: str,
        look: Cached[tuple[list[S], list[Binned]]],
        store: Store,
        viewer: Viewer,
    ) -> None:
        self._word, self._none, self._look, self._store = word, none, look, store
        self._viewer = viewer
        self._looking = False
        self._shown: list[S] | None = None
        self._binned: list[Binned] | None = None
        with card(f"{word.capitalize()}s", icon, f"{word}s"):
            self._list = tagged(ui.element("div").classes("list"), f"{word}s")
            with html.details().classes("fold"):
                with html.summary():
                    self._summary = text(f"{word}-bin-summary", "Recycle bin")
                self._bin_list = tagged(ui.element("div").classes("list"), f"{word}-bin")

    async def update(self) -> None:
        """Show what is stored by now; the disk is looked at in a thread."""
        if self._looking:  # a disk that hangs must not be asked again and again
            return
        self._looking = True
        try:
            found = await run.io_bound(self._look)
        finally:
            self._looking = False
        if found is not None and not self._viewer.client.is_deleted:
            self._show(*found)

    def facts(self, one: S) -> Sequence[str]:
        """Return what is told of a thing below its name; what is empty is left out."""
        raise NotImplementedError

    def acts(self, one: S) -> None:
        """Make the buttons of a thing; `download` and `delete` are some."""
        raise NotImplementedError

    def download(self, name: str, file: str) -> None:
        """Make a button that fetches a thing as a file of the store."""
        link: Element = html.a(href=f"/{self._word}s/{quote(file)}", download=file)
        link.classes("button quiet").props["aria-label"] = f"Download {name}"
        link.props["title"] = "Download"
        with tagged(link, "download"):
            html.i("download").classes("q-icon material-icons notranslate")

    def deleter(self, name: str) -> None:
        """Make a button that deletes a thing, for who may."""

        async def delete() -> None:
            if await self._viewer.confirm(f"Move {name} to the recycle bin?", "Delete"):
                await self._viewer.run(lambda: self._store.delete(name))
                await self.anew()

        if self._viewer.session.may_drive:
            button(f"Delete {name}", "delete", delete, "quiet", "delete")

    async def anew(self) -> None:
        """Look at the disk again."""
        self._look.expire()
        await self.update()

    def _show(self, stored: list[S], binned: list[Binned]) -> None:
        if stored != self._shown:
            self._shown = stored
            self._fill()
        if binned != self._binned:
            self._binned = binned
            self._fill_bin()

    def _fill(self) -> None:
        self._list.clear()
        with self._list:
            for one in (self._shown or [])[:MOST]:
                with _item(one.name, self.facts(one), f"stored-{self._word}"):
                    self.acts(one)
            if not self._shown:
                ui.label(self._none).classes("soft")
            elif len(self._shown) > MOST:
                ui.label(f"and {len(self._shown) - MOST} older ones").classes("soft")

    def _fill_bin(self) -> None:
        binned, may = self._binned or [], self._viewer.session.may_drive
        self._summary.text = f"Recycle bin ({len(binned)})" if binned else "Recycle bin is empty"
        self._bin_list.clear()
        with self._bin_list:
            for one in binned[:MOST]:
                facts = [f"deleted {moment(one.deleted)}", size(one.size)]
                with _item(one.original, facts, "binned"):
                    if may:
                        act = self._restorer(one.name)
                        button("Restore", "restore", act, "quiet", "restore_from_trash")
            if binned and may:
                button("Empty the recycle bin", "purge", self._purge, "danger", "delete_forever")

    def _restorer(self, name: str) -> Any:
        async def restore() -> None:
            await self._viewer.run(lambda: self._store.restore(name))
            await self.anew()

        return restore

    async def _purge(self) -> None:
        if await self._viewer.confirm(
            f"Delete all {self._word}s in the recycle bin for good?", "Delete for good"
        ):
            await self._viewer.run(self._store.purge)
            await self.anew()


def moment(seconds: float) -> str:
    """Return a time in s since 1970 as date and time of day."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def _item(name: str, facts: Sequence[str], kind: str) -> Element:
    """Return a row for what has a name; buttons go into it."""
    row = tagged(ui.element("div").classes("item"), kind)
    row.props["data-name"] = name
    with row, ui.element("div").classes("what"):
        ui.label(name).classes("name")
        ui.label(" · ".join(filter(None, facts))).classes("soft")
    return row
