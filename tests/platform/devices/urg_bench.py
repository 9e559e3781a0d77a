"""A driver and an emulated sensor on one bench, in simulated time."""

import threading

import numpy as np

from impslam.platform.devices import base, scip_link, urg, urg_start
from impslam.platform.devices.scip_link import ScipLink
from impslam.platform.devices.urg import Urg
from impslam.platform.virtual.urg import UrgEmulator
from impslam.types import Event, LaserScan

HOST = 1.7e9  # s, host time when the virtual robot began
BEAMS = 682
TICK = 5e-4  # s between reads of the line


class Room:
    """Ranges that encode their sweep; records the true start of each sweep."""

    def __init__(self):
        self.began = []

    def ranges(self, time):
        self.began.append(time)
        return self.of(len(self.began) - 1)

    @staticmethod
    def of(number):
        ranges = 1.0 + 0.001 * ((np.arange(BEAMS) * 7 + 13 * number) % 4000)
        ranges[::50] = 0.0  # no echo
        return ranges


class Bench:
    """The port between driver and emulator, with delays of USB, and their clock."""

    port, baudrate = "bench", 115200

    def __init__(self, emulator, monkeypatch, stop_after=10, seconds=600.0, spoil=None, **settings):
        self.emulator, self.time, self.end = emulator, 0.0, seconds
        self.spoil = spoil or (lambda data: data)
        self.at = []  # events of the emulator: (time, action), in order
        self.rng = np.random.default_rng(5)
        self.readings, self.sent = [], []
        self.stop_after = stop_after
        self.driver = Urg(port="bench", label="lidar", **settings)
        self.driver._stopping = self.stopping = BenchEvent(self)
        self.driver._receiver = self._receive
        for module in (base, scip_link, urg):
            monkeypatch.setattr(module, "now", self.now)
        monkeypatch.setattr(scip_link, "read_some", self.read)
        monkeypatch.setattr(scip_link, "write_all", self.write)
        monkeypatch.setattr(urg_start, "BIT_RATES", (115200,))

    def run(self):
        """Serve one opened port to its end; return the scans."""
        self.driver._run_link(ScipLink(self, self.stopping, self.driver._count))
        return self.scans

    @property
    def scans(self):
        return [r.message for r in self.readings if isinstance(r.message, LaserScan)]

    @property
    def events(self):
        return [r.message.text for r in self.readings if isinstance(r.message, Event)]

    @property
    def counts(self):
        return self.driver.health().counts

    def now(self):
        return HOST + self.time

    def wait(self, seconds):
        """Advance the time; fail if a test would never end."""
        self.time += seconds
        while self.at and self.at[0][0] <= self.time:
            self.at.pop(0)[1]()
        if self.time > self.end:
            self.stopping.set()

    def read(self, _, wait):
        left = wait
        while left > 0.0:
            self.wait(TICK)
            left -= TICK
            if data := self.spoil(self.emulator.due(self.time)):
                self.time += float(self.rng.exponential(2e-4))
                return data
        return b""

    def write(self, _, data):
        self.sent.append(data)
        self.wait(1e-4)
        self.emulator.receive(data, self.time)

    def _receive(self, reading):
        self.readings.append(reading)
        if len(self.scans) >= self.stop_after:
            self.stopping.set()


class BenchEvent(threading.Event):
    """An event that waits in the bench's time."""

    def __init__(self, bench):
        super().__init__()
        self.bench = bench

    def wait(self, timeout=None):
        if not self.is_set():
            self.bench.wait(timeout)
        return self.is_set()


def sensor(**options):
    """Return an emulated sensor and its room."""
    room = Room()
    return UrgEmulator(room, **options), room
