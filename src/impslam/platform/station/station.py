"""The robot computer: reads devices, records, maps, and sends drive commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from impslam.config import Config, load, presets
from impslam.errors import ImpError
from impslam.observers.live_view import LiveView
from impslam.platform.devices.base import Device, DeviceHealth, DriveDevice, Reading, event, now
from impslam.platform.station.continued_map import load_continued_map
from impslam.platform.station.drive_control import DriveControl
from impslam.platform.station.log_store import LogStore
from impslam.platform.station.map_keeper import MapKeeper
from impslam.platform.station.map_store import MapStore
from impslam.platform.station.mapper import LiveMapper
from impslam.platform.station.mapper_status import MapperStatus
from impslam.platform.station.recorder import LogRecorder, RecordingStatus
from impslam.platform.station.topics import TopicNames
from impslam.types import Climate, Event, Image, Velocity

MAX_EVENTS = 200  # kept for the page; the log has all of them


@dataclass(frozen=True, slots=True)
class StationHealth:
    """The status of all parts, for the page."""

    devices: Mapping[str, DeviceHealth]
    recording: RecordingStatus
    mapping: MapperStatus
    climate: Climate | None = None


class Station:
    """Connects the devices, the recorder, the live map and drive control.

    Parameters
    ----------
    devices : by name
    preset : name of the preset or TOML file of the live map; recorded in logs as well
    folder : where logs (and maps, in `maps/`) are kept
    limits : maximum commands, m/s and rad/s
    floor : bytes that stay free on the disk
    """

    def __init__(
        self,
        devices: Mapping[str, Device],
        preset: str,
        folder: Path,
        limits: tuple[float, float],
        floor: int,
    ) -> None:
        self.devices, self.folder, self.limits = devices, folder, limits
        self.store = LogStore(folder)
        self._preset, config = preset, load(preset)
        self._topics = TopicNames(config.make_robot().streams.wanted)
        self.recorder = LogRecorder(
            folder, _portable(preset, config), floor, self._notify, self._topics
        )
        self.view = LiveView()
        self.mapper = LiveMapper(config, self.view)
        drives = [device for device in devices.values() if isinstance(device, DriveDevice)]
        self.drive_control = DriveControl(
            drives[0] if drives else None, limits, self._notify, self._record_command
        )
        maps = folder / "maps"
        self.keeper = MapKeeper(self.mapper, maps, self._notify)
        self.maps = MapStore(maps, lambda: self.keeper.name, self.keeper.forget)
        self.events: list[Event] = []
        self.picture: Image | None = None
        self.climate: Climate | None = None

    def start(self) -> None:
        """Start everything but recording and mapping."""
        self.drive_control.start()
        self.mapper.warm_up()
        self.keeper.start()
        for device in self.devices.values():
            device.start(self.receive)

    def begin(self, *, record: bool, map_: bool) -> None:
        """Start recording and mapping if wanted; report errors, and continue without."""
        starts: dict[Callable[[], object], bool] = {
            self.recorder.start: record,
            self.start_mapping: map_,
        }
        for start, wanted in starts.items():
            try:
                if wanted:
                    start()
            except ImpError as error:
                self._notify("error", str(error))

    def stop(self) -> None:
        """Stop the robot, close the log, save the map, and end every thread.

        An error in one part does not keep the others from stopping.
        """
        with ExitStack() as parts:  # last in, first out
            parts.callback(self.keeper.stop)
            parts.callback(self.mapper.stop)
            parts.callback(self.recorder.stop)
            for device in reversed(list(self.devices.values())):
                parts.callback(device.stop)
            parts.callback(self.drive_control.stop)

    def start_mapping(self) -> None:
        """Save the present map and begin a new one, with the robot at its origin."""
        self.keeper.begin()

    def end_mapping(self) -> None:
        """Save the present map and end mapping."""
        self.keeper.end()

    def continue_map(self, name: str, *, frozen: bool = False) -> None:
        """Save the present map and continue one of the store, or (`frozen`) localise in it.

        The robot is located in the map while it drives.
        """
        self.keeper.begin(load_continued_map(self.maps.path(name), self._preset, frozen=frozen))

    def hint(self, x: float, y: float) -> None:
        """Search for the robot near a position (m) in the continued map."""
        self.keeper.hint(x, y)

    def save_map(self) -> Path:
        """Write the present map and all other files of a run into its folder; mapping goes on."""
        return self.keeper.save()

    @property
    def map_folder(self) -> Path | None:
        """The folder of the present map, also of an ended one; None if it is not saved, or deleted."""
        return self.keeper.folder

    def health(self) -> StationHealth:
        """Return the status of all parts."""
        devices = {name: device.health() for name, device in self.devices.items()}
        return StationHealth(devices, self.recorder.status(), self.mapper.status(), self.climate)

    def receive(self, reading: Reading) -> None:
        """Process one reading, from any thread; never blocks, because devices call it."""
        message = reading.message
        self.recorder.put(reading)
        if isinstance(message, Event):
            self._keep_event(message)
        elif isinstance(message, Image):
            self.picture = message
        elif isinstance(message, Climate):
            self.climate = message
        else:
            self.mapper.put(message, reading.arrived, self._topics.topic(message, reading.device))

    def _record_command(self, speed: float, turn_rate: float) -> None:
        """Record a drive command, but keep it from the mapper: it is not odometry."""
        moment = now()
        self.recorder.put(Reading(Velocity(moment, speed, turn_rate), moment, "drive_control"))

    def _notify(self, level: str, text: str) -> None:
        """Log an event of the robot as a whole, and show it on the page."""
        self.receive(event("robot", level, text))

    def _keep_event(self, message: Event) -> None:
        self.events.append(message)
        del self.events[:-MAX_EVENTS]


def _portable(preset: str, config: Config) -> str:
    """Return the name of a preset, or the TOML of a config file, which others would not find."""
    return preset if preset in presets() else tomli_w.dumps(config.resolved())
