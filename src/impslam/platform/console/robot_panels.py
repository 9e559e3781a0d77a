"""All panels beside a robot's map: the drive panel stays visible, the others are in tabs."""

from __future__ import annotations

from collections.abc import Collection

from nicegui import background_tasks, html
from nicegui.element import Element

from impslam.platform.console.camera import CameraView
from impslam.platform.console.drive_panel import DrivePanel
from impslam.platform.console.fault_panel import fault_panel
from impslam.platform.console.feed import Feed
from impslam.platform.console.header import Header
from impslam.platform.console.health_panel import EventPanel, HealthPanel
from impslam.platform.console.log_panel import LogPanel, RecordPanel
from impslam.platform.console.mapping_panel import MappingPanel
from impslam.platform.console.maps_panel import MapsPanel
from impslam.platform.console.tabs import Tabs
from impslam.platform.console.viewer import Viewer
from impslam.platform.console.widgets import card
from impslam.platform.devices.base import DriveDevice
from impslam.platform.station.station import Station, StationHealth

TABS = {
    "drive": ("sports_esports", "Drive"),
    "record": ("radio_button_checked", "Record"),
    "maps": ("map", "Maps"),
    "health": ("monitor_heart", "Health"),
    "camera": ("photo_camera", "Camera"),
}
"""Tab -> icon, title. If there is room, drive has a place of its own."""
DISK_UPDATE_RATIO = 2  # slow updates per update of the lists of files


class RobotPanels:
    """Drive, record, map, health, events, camera and logs of a station."""

    def __init__(self, feed: Feed, station: Station, viewer: Viewer, header: Header) -> None:
        assert header.stop is not None
        self._feed, self._station, self._header = feed, station, header
        self._count = 0
        health = feed.health()
        with html.aside().classes("side"):
            with _tab("drive"):
                self._drive = DrivePanel(station, viewer, header.stop)
            Tabs(TABS)  # after drive: the key Tab follows the layout
            with _tab("record"):
                self._record = RecordPanel(station, viewer)
                self._mapping = MappingPanel(station, viewer)
                self._logs = LogPanel(feed, station, viewer)
            with _tab("maps"):
                self._maps = MapsPanel(feed, station, viewer)
            with _tab("health"):
                self._health = HealthPanel(feed, health)
                if feed.model.virtual is not None and viewer.session.may_drive:
                    fault_panel(feed.model.virtual, viewer)
                self._events = EventPanel()
            with _tab("camera"), card("Camera", "photo_camera", "camera"):
                CameraView()

    def fast(self) -> None:
        """Update the drive panel."""
        self._drive.update()

    def slow(self) -> list[str]:
        """Update all other panels, and return the alarms of the robot."""
        health = self._feed.health()
        drive_control = self._station.drive_control.state()
        self._header.update(
            health.recording, f"{drive_control.name} drives" if drive_control.driver else ""
        )
        self._record.update(health.recording)
        self._mapping.update(health.mapping)
        self._health.update(health)
        self._events.update(list(self._station.events))
        if self._count % DISK_UPDATE_RATIO == 0:
            background_tasks.create(self._logs.update(), name="logs")
            background_tasks.create(self._maps.update(), name="maps")
        self._count += 1
        devices = self._station.devices.items()
        drives = {name for name, device in devices if isinstance(device, DriveDevice)}
        virtual = self._feed.model.virtual
        failure = "" if virtual is None else virtual.failure
        return alarms(health, drive_control.blockage, drives, failure)

    def leave(self) -> None:
        """Release control."""
        self._drive.leave()


def alarms(
    health: StationHealth, blockage: str, drives: Collection[str], failure: str = ""
) -> list[str]:
    """Return what the driver must know, whatever panel is open.

    A lost drive device comes first, since it cannot be stopped; then other lost devices, why the robot does
    not move as it is driven, and why it does not map or record any more.

    Parameters
    ----------
    health : of the robot
    blockage : why the robot does not move as it is driven, "" if it does
    drives : names of the drive devices
    failure : why the virtual robot does not run any more, "" if it does; no plug needs to be checked
    """
    lost = [name for name, one in health.devices.items() if one.state == "lost"]
    lost.sort(key=lambda name: name not in drives)
    found = [f"{name} lost: {health.devices[name].detail}" for name in lost if not failure]
    found += [text[:1].upper() + text[1:] for text in (failure, blockage) if text]
    if health.mapping.state == "failed":
        found.append(f"Mapping has failed: {health.mapping.detail}")
    if health.recording.error and not health.recording.active:
        found.append(f"Not recording: {health.recording.error}")
    return found


def _tab(name: str) -> Element:
    panel: Element = html.div().classes(f"panel panel-{name}")
    return panel
