"""The header of the page: status of the robot, session, and emergency stop."""

from __future__ import annotations

from nicegui import html, ui

from impslam.platform.console.model import Model
from impslam.platform.console.stop_button import StopButton
from impslam.platform.console.theme_button import ThemeButton
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import duration, show, symbol, tagged, text
from impslam.platform.station.recorder import RecordingStatus
from impslam.platform.station.station import Station


class Header:
    """Title, status chips, theme, and STOP.

    Attributes
    ----------
    stop : the emergency stop, None in a replay
    """

    def __init__(self, model: Model, viewer: Viewer) -> None:
        self.stop: StopButton | None = None
        with html.header().classes("top"):
            symbol("smart_toy" if model.station is not None else "replay").classes("mark")
            html.h1(model.title)
            self._recording = self._chip("chip-recording", "recording")
            self._driver = self._chip("chip-driver", "driver")
            html.div().classes("space")
            right = " · may drive" if model.station is not None else ""
            right = right if viewer.session.may_drive else " · watching"
            tagged(html.span(viewer.session.name + right), "viewer").classes("soft viewer")
            ThemeButton()
            _logout()
            if model.station is not None:
                self.stop = StopButton(lambda: self._on_stop(model.station, viewer))

    def update(self, recording: RecordingStatus, driver: str) -> None:
        """Show the recording, and who drives."""
        show(self._recording, recording.active)
        self._recording.text = f"REC {duration(recording.seconds)}"
        show(self._driver, bool(driver))
        self._driver.text = driver

    @staticmethod
    def _chip(testid: str, style: str) -> ui.label:
        chip = text(testid, "", f"chip {style}")
        show(chip, False)
        return chip

    @staticmethod
    def _on_stop(station: Station | None, viewer: Viewer) -> None:
        assert station is not None
        viewer.do(lambda: station.drive_control.emergency_stop(viewer.session.name), driving=False)


def _logout() -> None:
    """Add the button to log out: a form, so that it works without scripts."""
    with html.form().props("method=post action=/logout"), html.button() as leave:
        leave.classes("button quiet").props("type=submit")
        leave.props["aria-label"] = leave.props["title"] = "Log out"
        symbol("logout")
    tagged(leave, "logout")
