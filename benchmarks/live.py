"""Live mapping in real time: latency and CPU usage.

    python benchmarks/live.py [SECONDS]

The arena is simulated beforehand and then put into a `LiveMapper` at the rate of a robot: wheel angles,
and six other messages that the estimator does not use, at 100 Hz, and scans of 682 beams at 10 Hz after
their last beam. "latency" is from a scan's arrival to the snapshot that shows it; up to 10 ms of it is the
wait for the wheel angles up to the scan's end. In the middle the map is saved. CPU is that of the whole
process, in percent of a core, minus the same without mapping.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np

from impslam.config import load
from impslam.estimators.landmarks import Landmarks
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.live_view import LiveView
from impslam.platform.devices.base import now
from impslam.platform.station.mapper import LiveMapper
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import (
    Acceleration,
    Climate,
    DeviceTime,
    EncoderVoltages,
    Imu,
    LaserScan,
    MagneticField,
    Message,
    Observation,
    WheelAngles,
)

PERIOD = 0.005  # s between two iterations of the feeder


class Timed(LiveView):
    """A view that records the age of each scan when it is shown."""

    def __init__(self) -> None:
        super().__init__()
        self.latencies: list[tuple[float, float]] = []

    def follow(self, track: Track, path: PathRows) -> None:
        super().follow(track, path)
        self._note()

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        super().revise(keyframe, revision, path)
        self._note()

    def _note(self) -> None:
        self.latencies.append((now(), now() - self.snapshot().arrived))


class Ticker(threading.Thread):
    """Measures how long other threads of the process are blocked."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.late: list[tuple[float, float]] = []
        self.over = False

    def run(self) -> None:
        while not self.over:
            begin = time.monotonic()
            time.sleep(0.01)
            self.late.append((now(), time.monotonic() - begin - 0.01))


def record(seconds: float) -> list[tuple[float, Message]]:
    """Return messages with their arrival times, relative to the first."""
    log: list[tuple[float, Message]] = []
    zero = None
    for message in simulate(load_world("arena")):
        zero = message.stamp if zero is None else zero
        at = message.stamp - zero
        if at > seconds:
            break
        if isinstance(message, LaserScan):
            log.append((at + float(message.time_offsets[-1]), replace(message, stamp=at)))
        elif isinstance(message, WheelAngles):
            log += [(at, other) for other in (replace(message, stamp=at), *others(at))]
    return sorted(log, key=lambda pair: pair[0])


def others(at: float) -> list[Message]:
    three = np.zeros(3)
    return [
        EncoderVoltages(at, 1.0, 1.0),
        Imu(at, three, three),
        Acceleration(at, three),
        MagneticField(at, three),
        Climate(at, 20.0, 0.5),
        DeviceTime(at, "autopilot", at),
    ]


def feed(mapper: LiveMapper, log: list[tuple[float, Message]]) -> float:
    """Put each message at its time; return the CPU seconds per second of the process."""
    zero, cpu, i = now(), time.process_time(), 0
    while i < len(log):
        while i < len(log) and zero + log[i][0] <= now():
            at, message = log[i]
            mapper.put(replace(message, stamp=zero + message.stamp), zero + at)
            i += 1
        time.sleep(PERIOD)
    return (time.process_time() - cpu) / (now() - zero)


def tell(what: str, values: np.ndarray) -> None:
    median, p99 = 1e3 * np.percentile(values, (50, 99))
    print(f"{what:<44} median {median:6.2f}, p99 {p99:6.2f}, max {1e3 * values.max():6.2f} ms")


def between(pairs: list[tuple[float, float]], begin: float, end: float) -> np.ndarray:
    return np.array([value for at, value in pairs if begin <= at <= end])


def map_live(seconds: float) -> None:
    log = record(seconds)
    view = Timed()
    idle = feed(LiveMapper(load("imp"), view), log[: len(log) // 5])  # off: takes nothing
    mapper, ticker = LiveMapper(load("imp"), view), Ticker()
    begin = time.monotonic()
    mapper.start()
    while mapper.status().state == "compiling":
        time.sleep(0.01)
    print(f"ready to map after {time.monotonic() - begin:.1f} s")
    ticker.start()
    saving: list[float] = []
    with tempfile.TemporaryDirectory() as folder:

        def save() -> None:
            saving.append(now())
            mapper.save(Path(folder) / "map")
            saving.append(now())

        timer = threading.Timer(0.6 * seconds, save)
        timer.start()
        cpu = feed(mapper, log)
        timer.join()
    ticker.over = True
    status, quiet = mapper.status(), (0.0, saving[0])
    mapper.stop()
    came = sum(isinstance(message, LaserScan) for _, message in log)
    print(f"{came} scans, {status.steps} mapped, {status.dropped_scans} dropped, {status.detail!r}")
    tell("latency, scan arrived to snapshot", between(view.latencies, *quiet))
    tell("other threads held up by", between(ticker.late, *quiet))
    print(
        f"CPU {100 * (cpu - idle):.1f} % of a core (one save included), feeding {100 * idle:.1f} %"
    )
    print(f"save: {saving[1] - saving[0]:.2f} s")
    tell("  latency meanwhile", between(view.latencies, saving[0], saving[1] + 0.2))
    tell("  other threads held up by", between(ticker.late, *saving))


def read_landmarks() -> None:
    for count in (10, 100, 1000):
        estimator = load("imp").make_estimator()
        assert isinstance(estimator, Landmarks)
        places = np.random.default_rng(0).uniform(0.0, 100.0, (count, 2))
        seen = [Observation("cylinder", place, np.eye(2) * 1e-4) for place in places]
        estimator._filter.extend(seen, 0.0)
        times = []
        for _ in range(30):
            begin = time.perf_counter()
            estimator.landmarks()
            times.append(time.perf_counter() - begin)
        tell(f"reading {count} landmarks", np.array(times))


if __name__ == "__main__":
    map_live(float(sys.argv[1]) if len(sys.argv) > 1 else 30.0)
    read_landmarks()
