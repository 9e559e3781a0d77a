"""The drive panel: who has control, and the driver's commands."""

from __future__ import annotations

from nicegui import ui
from nicegui.events import GenericEventArguments

from impslam.errors import ImpError
from impslam.platform.console.drive_pad import DrivePad, pad_command
from impslam.platform.console.stop_button import StopButton
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, line, show, text
from impslam.platform.station.drive_control import DriveControlState
from impslam.platform.station.station import Station


class DrivePanel:
    """Take and release control, drive, release the emergency stop; for watchers: who drives."""

    def __init__(self, station: Station, viewer: Viewer, stop: StopButton) -> None:
        self._station, self._viewer, self._stop = station, viewer, stop
        self._pad: DrivePad | None = None
        with card("Drive", "sports_esports", "drive"):
            with line():
                self._who = text("driver", "Nobody drives", "who")
                self._take = button(
                    "Take control", "take", self._on_take, "primary", "sports_esports"
                )
                self._leave = button("Release control", "leave", self._on_leave)
            with ui.element("div").classes("notice") as self._stopped:
                self._why = text("stopped", "")
                self._release = button("Release", "release", self._on_release, "danger")
            if viewer.session.may_drive:
                self._pad = DrivePad(station.limits).on("command", self._on_command)
            else:
                text("watching", "You are watching. Anyone may press STOP.", "soft")
        self.update()

    def update(self) -> None:
        """Show who drives, and whether the robot is stopped."""
        state = self._station.drive_control.state()
        may, mine = self._viewer.session.may_drive, state.driver == self._viewer.driver
        same = state.name == self._viewer.session.name
        self._who.text = self._driver_text(state, mine=mine, same=same)
        show(self._take, may and (state.driver is None or (same and not mine)))
        show(self._leave, mine)
        show(self._stopped, bool(state.stopped))
        self._why.text = state.stopped.capitalize()
        show(self._release, mine)
        self._stop.show(stopped=bool(state.stopped))
        if self._pad is not None:
            self._pad.enable(driving=mine and not state.stopped)

    def leave(self) -> None:
        """Release control, as the page is gone, or its session has ended."""
        self._station.drive_control.leave(self._viewer.driver)

    @staticmethod
    def _driver_text(state: DriveControlState, *, mine: bool, same: bool) -> str:
        if state.driver is None:
            return "Nobody drives"
        who = "You drive" if mine or same else f"{state.name} drives"
        where = " on another page" if same and not mine else ""
        if abs(state.speed) >= 0.005:
            return f"{who}{where}, {state.speed:.2f} m/s"
        return f"{who}{where}{', turning' if state.turn_rate else ''}"

    def _on_take(self) -> None:
        session = self._viewer.session
        self._viewer.do(lambda: self._station.drive_control.take(self._viewer.driver, session.name))
        self.update()

    def _on_leave(self) -> None:
        self.leave()
        self.update()

    def _on_release(self) -> None:
        self._viewer.do(lambda: self._station.drive_control.release(self._viewer.driver))
        self.update()

    def _on_command(self, event: GenericEventArguments) -> None:
        """Pass a command to drive control; a browser may send it even if the page shows no pad."""
        command = pad_command(event.args)
        if command is None or self._viewer.refused():
            return
        forward, left, late = command
        speed, turn_rate = self._station.limits
        try:
            self._station.drive_control.drive(
                self._viewer.driver, forward * speed, left * turn_rate, late
            )
        except ImpError:
            self.update()  # someone else has control by now: show it
