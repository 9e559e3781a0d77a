"""Buttons that trigger faults of a virtual robot."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from nicegui import html

from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import button, card, line, tagged
from impslam.platform.virtual import faults
from impslam.platform.virtual.faults import (
    Carry,
    Delay,
    LineNoise,
    Malfunction,
    Reboot,
    Stall,
    Unplug,
)

if TYPE_CHECKING:
    from impslam.platform.virtual.process import VirtualRobot

SECONDS = 2.0  # s that a fault lasts: longer than the timeouts of devices
FRAMES, SCANS = 0.01, 3e-4
"""1/byte: noise that corrupts every second frame (of 70 bytes), every second scan (of 2100)."""
FAULTS: Mapping[str, Mapping[str, faults.Fault]] = {
    "autopilot": {
        "Noise": LineNoise(device="autopilot", rate=FRAMES, seconds=SECONDS),
        "Unplug": Unplug(device="autopilot", seconds=SECONDS),
        "Hold back": Delay(device="autopilot", seconds=SECONDS),
        "Reboot": Reboot(device="autopilot"),
    },
    "lidar": {
        "Noise": LineNoise(device="lidar", rate=SCANS, seconds=SECONDS),
        "Unplug": Unplug(device="lidar", seconds=SECONDS),
        "Hold back": Delay(device="lidar", seconds=SECONDS),
        "Reboot": Reboot(device="lidar"),
        "Malfunction": Malfunction(),
    },
    "camera": {
        "Unplug": Unplug(device="camera", seconds=SECONDS),
        "Freeze": Delay(device="camera", seconds=SECONDS),
    },
    "motors": {"Stall": Stall(side="both", seconds=SECONDS)},
    "robot": {"Carry to its start": Carry()},
}
"""Device -> label of a button -> its fault."""


def fault_panel(virtual: VirtualRobot, viewer: Viewer) -> None:
    """Add a button for each fault of each device."""
    with card("Virtual robot", "bolt", "faults"), html.details().classes("fold"):
        tagged(html.summary(f"Inject a fault for {SECONDS:.0f} s"), "faults")
        for device, offered in FAULTS.items():
            html.h3(device.capitalize())
            with line():
                for label, one in offered.items():
                    act = partial(viewer.run, partial(virtual.fault, **one.model_dump()))
                    button(label, f"fault-{device}-{one.fault}", act)
