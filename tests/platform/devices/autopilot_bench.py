"""A driver and an emulated autopilot on one bench, in simulated time."""

import threading
from contextlib import closing

import numpy as np

from impslam.platform.devices import autopilot, autopilot_link, base
from impslam.platform.devices.autopilot import Autopilot
from impslam.platform.devices.base import DeviceError
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.types import Event

HOST = 1.7e9  # s, host time when the virtual robot began
TICK = 1e-3  # s between reads of the line
RADIUS = 0.0635  # m


class Vehicle:
    """Two wheels that follow commands at once; records commands and times."""

    def __init__(self):
        self.time, self.angles, self.speeds = 0.0, np.zeros(2), np.zeros(2)
        self.stalled, self.commands = (False, False), []
        self.blocked = False  # by a wall: the wheels stand, whatever the motors do

    def advance(self, time):
        if not self.blocked:
            self.angles += self.speeds / RADIUS * (time - self.time)
        self.time = time

    def drive(self, left, right):
        self.speeds = np.array([left, right])
        self.commands.append((self.time, left, right))

    def wheel_angles(self):
        return tuple(self.angles.tolist())

    def inertial(self):
        return np.array([0.01, -0.02, 0.5]), np.array([0.1, -0.2, 9.81])

    def heading(self):
        return 0.5


class Bench:
    """The port between driver and emulator, with delays of USB, and their clock."""

    port = "bench"

    def __init__(self, monkeypatch, drift=50e-6, seed=3, **settings):
        self.time, self.end = 0.0, 0.0
        self.vehicle = Vehicle()
        self.emulator = AutopilotEmulator(self.vehicle, drift=drift, seed=seed)
        self.rng = np.random.default_rng(seed)
        self.at = []  # events: (time, action), in order
        self.spoil = lambda data: data  # corrupts the autopilot's bytes
        self.spoil_commands = lambda data: data
        self.plugged, self.blocked, self.closed = True, False, 0
        self.readings, self._under_way = [], []
        self.driver = Autopilot(port="bench", label="imp", min_delay=0.0, **settings)
        self.driver._stopping = BenchEvent(self)
        self.driver._receiver = self._receive
        for module in (base, autopilot, autopilot_link):
            monkeypatch.setattr(module, "now", lambda: HOST + self.time)
        monkeypatch.setattr(autopilot, "opened", lambda *where: closing(self.open(*where)))
        monkeypatch.setattr(autopilot, "read_some", self.read)
        monkeypatch.setattr(autopilot_link, "write_all", self.write)

    # what tests do

    def run(self, seconds):
        """Run the driver's thread for some time."""
        self.end = self.time + seconds
        self.driver._keep_serving()

    def later(self, seconds, action):
        self.at.append((self.time + seconds, action))
        self.at.sort(key=lambda pair: pair[0])

    def drive_on(self, speed, turn_rate, seconds):
        """Command as drive control does, every 0.05 s."""
        for delay in np.arange(0.0, seconds, 0.05):
            self.later(delay, lambda: self.driver.drive(speed, turn_rate))

    def messages(self, kind):
        return [r.message for r in self.readings if isinstance(r.message, kind)]

    @property
    def events(self):
        return [event.text for event in self.messages(Event)]

    @property
    def health(self):
        return self.driver.health()

    # what the driver sees

    def open(self, url, baud):
        self._let_pass(1e-3)
        if not self.plugged:
            raise DeviceError("bench: no such port; plug it in")
        self._under_way.clear()
        return self

    def close(self):
        self.closed += 1

    def read(self, port, wait=0.05):
        end = self.time + wait
        while self.time < end - 1e-9:
            self._let_pass(TICK)
            if not self.plugged:
                raise DeviceError("bench: has been lost; check the plug")
            come = b"".join(data for at, data in self._under_way if at <= self.time)
            if come:
                self._under_way = [(at, data) for at, data in self._under_way if at > self.time]
                return come
        return b""

    def write(self, port, data):
        if not self.plugged or self.blocked:
            raise DeviceError("bench: accepts no more data; check the device")
        self.emulator.receive(self.spoil_commands(data), self.time)

    def _let_pass(self, seconds):
        """Advance the world in ticks."""
        end = self.time + seconds
        while self.time < end - 1e-9:
            self.time = round(self.time + TICK, 6)
            self.vehicle.advance(self.time)
            while self.at and self.at[0][0] <= self.time:
                self.at.pop(0)[1]()
            data = self.spoil(self.emulator.due(self.time))
            if data and self.plugged:
                delay = self.rng.exponential(0.5e-3) + self.rng.uniform(0.0, 2e-3)
                last = self._under_way[-1][0] if self._under_way else 0.0
                self._under_way.append((max(last, self.time + delay), data))

    def _receive(self, reading):
        self.readings.append(reading)


class BenchEvent(threading.Event):
    """An event that is set at the end of the bench's time; waiting advances the time."""

    def __init__(self, bench):
        super().__init__()
        self.bench = bench

    def is_set(self):
        return super().is_set() or self.bench.time >= self.bench.end

    def wait(self, timeout=None):
        if not self.is_set():
            self.bench._let_pass(timeout)
        return self.is_set()
