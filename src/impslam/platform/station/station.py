"""The robot computer: devices in, log and map out, commands back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from impslam.config import Config, load, presets
from impslam.errors import ImpError
from impslam.observers.live_view import LiveView
from impslam.platform.devices.base import Device, DriveDevice, Health, Reading, event, now
from impslam.platform.station.going_on import going_on
from impslam.platform.station.helm import Helm
from impslam.platform.station.map_keeper import MapKeeper
from impslam.platform.station.map_store import MapStore
from impslam.platform.station.mapper import LiveMapper
from impslam.platform.station.mapper_status import MapperStatus
from impslam.platform.station.recorder import LogRecorder, RecordingStatus
from impslam.platform.station.store import LogStore
from impslam.types import Climate, Event, Image, Velocity

EVENTS = 200  # kept for the page; the log has all


@dataclass(frozen=True, slots=True)
class StationHealth:
    """How everything is doing, for the page."""

    devices: Mapping[str, Health]
    recording: RecordingStatus
    mapping: MapperStatus
    climate: Climate | None = None


class Station:
    """Holds the devices, the recorder, the live map and the helm, and joins them.

    Parameters
    ----------
    devices : by name
    preset : name of the preset or file of TOML that the live map runs with; logs name it too
    folder : where logs (and maps, in `maps/`) are kept
    limits : m/s and rad/s, what the helm may ask for
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
        self.recorder = LogRecorder(folder, _portable(preset, config), floor, self._announce)
        self.view = LiveView()
        self.mapper = LiveMapper(config, self.view)
        drives = [device for device in devices.values() if isinstance(device, DriveDevice)]
        self.helm = Helm(drives[0] if drives else None, limits, self._announce, self._commanded)
        maps = folder / "maps"
        self.keeper = MapKeeper(self.mapper, maps, self._announce)
        self.maps = MapStore(maps, lambda: self.keeper.name)
        self.events: list[Event] = []
        self.picture: Image | None = None
        self.climate: Climate | None = None

    def start(self) -> None:
        """Start everything but recording and mapping."""
        self.helm.start()
        self.mapper.warm_up()
        self.keeper.start()
        for device in self.devices.values():
            device.start(self.receive)

    def begin(self, *, record: bool, map_: bool) -> None:
        """Record and map from the start; what cannot is told, and the robot goes on without."""
        starts: dict[Callable[[], object], bool] = {
            self.recorder.start: record,
            self.start_mapping: map_,
        }
        for start, wanted in starts.items():
            try:
                if wanted:
                    start()
            except ImpError as error:
                self._announce("error", str(error))

    def stop(self) -> None:
        """Stand still, close the log, save the map, and end every thread.

        A part that fails holds up no other.
        """
        with ExitStack() as parts:  # the last one in is the first one out
            parts.callback(self.keeper.stop)
            parts.callback(self.mapper.stop)
            parts.callback(self.recorder.stop)
            for device in reversed(list(self.devices.values())):
                parts.callback(device.stop)
            parts.callback(self.helm.stop)

    def start_mapping(self) -> None:
        """Begin a new map, the robot standing at its origin; the present one is saved."""
        self.keeper.begin()

    def go_on(self, name: str, *, frozen: bool = False) -> None:
        """Go on with a map of the store, or (`frozen`) localise in it; the present one is saved.

        Where in the map the robot is is found while it drives.
        """
        self.keeper.begin(going_on(self.maps.path(name), self._preset, frozen=frozen))

    def hint(self, x: float, y: float) -> None:
        """Seek the robot about a place (m) in the map that is gone on with."""
        self.keeper.hint(x, y)

    def save_map(self) -> Path:
        """Write the map as it is now, with all files of a run, into its folder; mapping goes on."""
        return self.keeper.save()

    def health(self) -> StationHealth:
        """Return how everything is doing."""
        devices = {name: device.health() for name, device in self.devices.items()}
        return StationHealth(devices, self.recorder.status(), self.mapper.status(), self.climate)

    def receive(self, reading: Reading) -> None:
        """Take one reading, from any thread; never blocks, because devices call it."""
        message = reading.message
        self.recorder.put(reading)
        if isinstance(message, Event):
            self._note(message)
        elif isinstance(message, Image):
            self.picture = message
        elif isinstance(message, Climate):
            self.climate = message
        else:
            self.mapper.put(message, reading.arrived)

    def _commanded(self, speed: float, turn_rate: float) -> None:
        """Record what the robot was told; it is no odometry, and the map must not take it for one."""
        moment = now()
        self.recorder.put(Reading(Velocity(moment, speed, turn_rate), moment, "helm"))

    def _announce(self, level: str, text: str) -> None:
        """Note what happened to the robot as a whole, in the log and on the page."""
        self.receive(event("robot", level, text))

    def _note(self, told: Event) -> None:
        self.events.append(told)
        del self.events[:-EVENTS]


def _portable(preset: str, config: Config) -> str:
    """Return what a log says of how it is mapped: a file here would not be found elsewhere."""
    return preset if preset in presets() else tomli_w.dumps(config.resolved())
