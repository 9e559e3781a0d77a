"""The emergency stop: always visible, for everyone, also on the keyboard."""

from __future__ import annotations

from collections.abc import Callable

from nicegui.element import Element


class StopButton(Element, component="stop_button.js"):
    """Calls `stop` when it, the space bar or Escape is pressed."""

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__()
        self._props["stopped"] = False
        self.on("stop", lambda _: stop())

    def show(self, *, stopped: bool) -> None:
        """Show whether the emergency stop is active."""
        if stopped != self._props["stopped"]:
            self._props["stopped"] = stopped
