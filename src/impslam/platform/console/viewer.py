"""The viewer of a page, and the rights to act there."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TypeVar

from nicegui import html, run, ui
from nicegui.client import Client

from impslam.errors import ImpError
from impslam.platform.console.session import Session
from impslam.platform.console.widgets import button, line

T = TypeVar("T")

_numbers = itertools.count(1)


class Viewer:
    """One open page of one session.

    Rights are checked at each command: a session may end at any time, and a browser may send commands
    whose button is not shown.

    Attributes
    ----------
    session : the login
    client : the open page
    driver : id of this page for drive control, so that two pages of a session do not drive at once
    """

    def __init__(self, session: Session, client: Client) -> None:
        self.session, self.client = session, client
        self.driver = f"{session.id}/{next(_numbers)}"

    def refused(self, *, driving: bool = True) -> str:
        """Return why a command is refused, "" if it is not."""
        if not self.session.alive():
            return "your session has ended; log in again"
        if driving and not self.session.may_drive:
            return "you may watch; log in with the drive password to change anything"
        return ""

    def do(self, work: Callable[[], object], *, driving: bool = True) -> bool:
        """Call a quick function; notify the user if it is refused or fails."""
        if reason := self.refused(driving=driving):
            return self._notify(reason)
        try:
            work()
        except ImpError as error:
            return self._notify(str(error))
        return True

    async def run(self, work: Callable[[], T]) -> T | None:
        """Call a slow function in a thread; notify the user if it is refused or fails."""
        if reason := self.refused():
            self._notify(reason)
            return None
        try:
            return await run.io_bound(work)
        except ImpError as error:
            self._notify(str(error))
        return None

    async def confirm(self, question: str, act: str) -> bool:
        """Ask a question in a dialog; return whether the user confirms."""
        with self.client, ui.dialog(value=True) as dialog, html.div().classes("dialog") as box:
            box.props("role=alertdialog")
            ui.label(question)
            with line("end"):
                button("Cancel", "cancel", lambda: dialog.submit(False))
                button(act, "confirm", lambda: dialog.submit(True), "danger")
        answer = await dialog
        if not self.client.is_deleted:
            dialog.delete()
        return bool(answer)

    def _notify(self, text: str) -> bool:
        self.session.refused(text)
        with self.client:  # not with the pressed button, which may be gone by now
            ui.notify(text, type="negative", position="bottom", timeout=6000, multi_line=True)
        return False
