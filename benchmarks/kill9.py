"""Kill a recorder without warning, many times, and measure the loss of data in its logs.

    python benchmarks/kill9.py [-n 100] [--together 3] [--seed 0]

A child process records at the full rate of the robot, in real time, and is killed (SIGKILL) at a random
moment. The log is then read as by `imp run`. The loss is the time between the last message in the log and
the kill; everything before must be there.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from impslam.columns import messages
from impslam.errors import ImpError
from impslam.platform.devices.base import Reading, now
from impslam.platform.station.recorder import LogRecorder
from impslam.sources.base import recognise
from impslam.types import (
    Acceleration,
    Climate,
    DeviceTime,
    EncoderVoltages,
    Image,
    Imu,
    LaserScan,
    MagneticField,
    WheelAngles,
)

BEAMS, SWEEP = 682, 0.1  # URG-04LX
MAX_LOSS = 1.0  # s
MAX_DELAY = 3.0  # s after the beginning until a child is killed
FAST = ("/encoders/voltage", "/imu", "/imu/acceleration_2", "/imu/magnetic_field", "/temperature")
FAST += ("/humidity", "/clock/autopilot")


class FullRate:
    """The robot's messages: an autopilot at 100 Hz, a lidar at 10 Hz, a camera at 5 Hz."""

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._angles = (np.arange(BEAMS) - BEAMS // 2) * 2.0 * np.pi / 1024
        self._times = np.arange(BEAMS) * SWEEP / 1024
        self._pictures = [self._rng.bytes(30_000) for _ in range(10)]

    def tick(self, number: int, stamp: float) -> Iterator[Reading]:
        """Yield the readings of the `number`-th hundredth of a second."""
        noise = self._rng.normal(size=(4, 3))
        device = 0.01 * number
        for message in (
            WheelAngles(stamp, 0.1 * number, 0.1 * number + noise[0, 0]),
            EncoderVoltages(stamp, 2.5 + noise[0, 1], 2.5 + noise[0, 2]),
            Imu(stamp, noise[0], noise[1]),
            Acceleration(stamp, noise[2]),
            MagneticField(stamp, 5e-5 * noise[3]),
            Climate(stamp, 20.0 + noise[1, 0], 0.5),
            DeviceTime(stamp, "autopilot", device),
        ):
            yield Reading(message, stamp, "autopilot", device)
        if number % 10 == 0:
            ranges = np.abs(self._rng.normal(3.0, 1.0, BEAMS))
            scan = LaserScan(stamp, self._angles, ranges, self._times, 0.02, 5.6)
            yield Reading(scan, stamp, "urg", device)
        if number % 20 == 0:
            picture = Image(stamp, "jpeg", self._pictures[number // 20 % 10])
            yield Reading(picture, stamp, "camera")


def record(folder: Path) -> None:
    """Record until killed, in real time; report the beginning."""
    robot, recorder = FullRate(), LogRecorder(folder, "imp", 0, lambda _level, _text: None)
    recorder.start()
    begin, number = now(), 0
    print(begin, flush=True)
    while True:
        number += 1
        time.sleep(max(0.0, begin + 0.01 * number - now()))
        for reading in robot.tick(number, now()):
            recorder.put(reading)


def kill_once(seed: int) -> float:
    """Return the seconds lost by one kill; inf if the log cannot be read."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="kill9-") as folder:
        command = [sys.executable, __file__, "--record", folder]
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        child = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
        assert child.stdout is not None
        with child.stdout as said:
            begun = float(said.readline())
            time.sleep(rng.uniform(0.0, MAX_DELAY))
            killed = time.time()  # on the clock of the child's time base
            child.send_signal(signal.SIGKILL)
            child.wait()
        (log,) = Path(folder).glob("*.mcap")
        try:
            return killed - _end(log, begun)
        except (ImpError, AssertionError) as error:
            print(f"seed {seed}: {error}")
            return float("inf")


def _end(log: Path, begun: float) -> float:
    """Return the end time of the log; `AssertionError` if anything before it is missing or changed."""
    with recognise(log)(path=log) as source:
        counts = {stream.name: stream.count for stream in source.streams()}
        read = list(messages(source.batches()))
    wheels = [message for message in read if isinstance(message, WheelAngles)]
    n = len(wheels)
    assert [wheel.left for wheel in wheels] == [0.1 * (i + 1) for i in range(n)], "wheels missing"
    for topic in FAST if n else ():
        # The kill may separate the readings of one tick, but not those of two.
        assert 0 <= n - (counts.get(topic) or 0) <= 1, f"{topic} has not what the wheels have"
    assert 0 <= n // 10 - (counts.get("/scan") or 0) <= 1, "scans missing"
    assert 0 <= n // 20 - (counts.get("/camera/image/compressed") or 0) <= 1, "pictures missing"
    return wheels[-1].stamp if wheels else begun


def main() -> None:
    """Kill, read, and print the losses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=100, help="how often to kill")
    parser.add_argument("--together", type=int, default=1, help="children at a time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--record", type=Path, help="be the child, and record into this folder")
    chosen = parser.parse_args()
    if chosen.record:
        record(chosen.record)
    with ThreadPoolExecutor(chosen.together) as pool:
        lost = np.array(list(pool.map(kill_once, range(chosen.seed, chosen.seed + chosen.n))))
    kept = np.isfinite(lost)
    print(
        f"{chosen.n} kills at 0 to {MAX_DELAY} s: {kept.sum()} logs open and are complete up to their "
        f"end; lost: median {np.median(lost):.2f} s, worst {lost.max():.2f} s; "
        f"{(lost <= MAX_LOSS).sum()} within {MAX_LOSS} s"
    )
    sys.exit(not (lost <= MAX_LOSS).all())


if __name__ == "__main__":
    main()
