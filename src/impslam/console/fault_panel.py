"""Faults on command, on the page of a virtual robot: what goes wrong there, without breaking anything."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from nicegui import html

from impslam.console.model import Fault
from impslam.console.viewer import Viewer
from impslam.console.widgets import button, card, line, tagged

SECONDS = 2.0  # s that a fault lasts: longer than a device's patience
HALF = {"autopilot": 0.01, "lidar": 3e-4}
"""1/byte: noise that spoils every second frame (of 70 bytes), every second scan (of 2100)."""

_UNPLUG = {"fault": "unplug", "seconds": SECONDS}
_DELAY = {"fault": "delay", "seconds": SECONDS}
_REBOOT = {"fault": "reboot"}
FAULTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "autopilot": {
        "Noise": {"fault": "noise", "rate": HALF["autopilot"], "seconds": SECONDS},
        "Unplug": _UNPLUG,
        "Hold back": _DELAY,
        "Reboot": _REBOOT,
    },
    "lidar": {
        "Noise": {"fault": "noise", "rate": HALF["lidar"], "seconds": SECONDS},
        "Unplug": _UNPLUG,
        "Hold back": _DELAY,
        "Reboot": _REBOOT,
        "Malfunction": {"fault": "malfunction"},
    },
    "camera": {"Unplug": _UNPLUG, "Freeze": _DELAY},
    "motors": {"Stall": {"fault": "stall", "side": "both", "seconds": SECONDS}},
}
"""Device -> what a button says -> the fault it asks for (`virtual.faults`)."""


class FaultPanel:
    """A button for each fault of each device; what follows from it, health and events tell."""

    def __init__(self, fault: Fault, viewer: Viewer) -> None:
        self._fault, self._viewer = fault, viewer
        with card("Virtual robot", "bolt", "faults"), html.details().classes("fold"):
            tagged(html.summary(f"Let something go wrong for {SECONDS:.0f} s"), "faults")
            for device, faults in FAULTS.items():
                html.h3(device.capitalize())
                with line():
                    for label, what in faults.items():
                        asked = what if device == "motors" else {**what, "device": device}
                        button(label, f"fault-{device}-{what['fault']}", partial(self._on, asked))

    async def _on(self, what: Mapping[str, Any]) -> None:
        await self._viewer.run(partial(self._fault, **what))
