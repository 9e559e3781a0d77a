"""The panel to play, pause, step and seek in a replay."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from nicegui import html

from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, duration, line, show, tagged, text
from impslam.platform.station.mapper_status import scans_text
from impslam.platform.station.player import Player, PlayerStatus, State

SPEEDS = {
    "0.25": "¼×",
    "0.5": "½×",
    "1": "1×",
    "2": "2×",
    "5": "5×",
    "10": "10×",
    "inf": "as fast as possible",
}
SEEK = "(e) => emit(e.offsetX / e.currentTarget.clientWidth)"
OVER = {"ended", "stopped", "failed", "writing"}
STATE_TEXTS = {
    "ready": "Ready to play",
    "compiling": "Compiling for this machine; once, up to a minute",
    "writing": "Writing the results",
    "ended": "The log is over",
}


class ReplayPanel:
    """Controls a player."""

    def __init__(self, player: Player, viewer: Viewer) -> None:
        self._player, self._viewer = player, viewer
        self._may = viewer.session.may_drive
        with card("Replay", "replay", "replay"):
            with line():
                play = button("Play", "play", self._on_play, "primary", "play_arrow")
                pause = button("Pause", "pause", self._on_pause, "primary", "pause")
                step = button("Step", "step", self._on_step, "plain", "skip_next")
                with tagged(html.select().classes("field"), "replay-speed") as speed:
                    for value, label in SPEEDS.items():
                        now = float(value) == self._player.status().speed
                        html.option(label, value=value, selected=now)
                speed.props["aria-label"] = "Speed"
                speed.on("change", self._on_speed, js_handler="(e) => emit(e.target.value)")
            self._controls = {"play": play, "pause": pause, "step": step, "speed": speed}
            self._bar = tagged(html.progress(max=1, value=0), "replay-position")
            self._bar.props["aria-label"] = "Position in the log; a click continues from there"
            if self._may:
                self._bar.classes("seek").on("click", self._on_seek, js_handler=SEEK)
            self._status = text("replay", "", "soft")
            self._detail = text("replay-detail", "", "soft")
        self.update()

    def update(self) -> None:
        """Show the present status of the player."""
        status = self._player.status()
        offered = controls(status.state) if self._may else ()
        for name, control in self._controls.items():
            show(control, name in offered)
        over = float(status.state in OVER)
        share = round(status.position / status.total, 3) if status.total else over
        if share != self._bar.props.get("value"):
            self._bar.props["value"] = share
        self._status.text = _status_text(status, share)
        self._detail.text = status.detail

    def _on_play(self) -> None:
        ready = self._player.status().state == "ready"
        self._do(self._player.start if ready else self._player.resume)

    def _on_pause(self) -> None:
        self._do(self._player.pause)

    def _on_step(self) -> None:
        self._do(self._player.step)

    def _on_speed(self, event: Any) -> None:
        if event.args in SPEEDS:
            self._do(lambda: self._player.set_speed(float(event.args)))

    def _on_seek(self, event: Any) -> None:
        if isinstance(event.args, int | float) and 0.0 <= event.args <= 1.0:
            self._do(lambda: self._player.seek(float(event.args)))

    def _do(self, work: Any) -> None:
        self._viewer.do(work)
        self.update()


def controls(state: State) -> Collection[str]:
    """Return the names of the controls that a driver is offered in a state of the player."""
    if state in OVER:
        return ()
    if state == "compiling":  # it then plays by itself
        return ("speed",)
    return ("pause", "speed") if state == "playing" else ("play", "step", "speed")


def _status_text(status: PlayerStatus, share: float) -> str:
    state = STATE_TEXTS.get(status.state, status.state.capitalize())
    usual = status.speed == 1 or math.isinf(status.speed) or status.state in OVER
    speed = "" if usual else f" at {status.speed:g}×"
    facts = (f"{100 * share:.0f} %", duration(status.seconds), scans_text(status.steps))
    return f"{state}{speed} · " + " · ".join(filter(None, facts))
