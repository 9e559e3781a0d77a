"""CPU usage and timing of the virtual IMP, with every device read at its full rate.

    python benchmarks/virtual.py [SECONDS]

It runs in a process of its own, as for `imp robot --virtual`; the host's drivers read autopilot (100 Hz),
lidar (10 Hz) and camera, and drive it in a slow circle. CPU usage is of one core. Lateness is the delay of
the loop's beginning after its millisecond; latency is from a drive command on the host to the motors. The
parts are timed separately, without ports.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np

from impslam.component import build
from impslam.platform.devices.base import Device, DriveDevice, Reading
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.platform.virtual.process import VirtualRobot
from impslam.simulation.body import Body
from impslam.simulation.body_lidar import LidarSweeps
from impslam.simulation.world import load_world

WORLD = "arena"
SPEED, TURN_RATE = (
    0.1,
    0.4,
)  # m/s and rad/s: a circle of 0.25 m radius, which the arena has room for
COMMANDS = 20.0  # Hz, as drive control sends them


def parts() -> None:
    """Print the CPU time per second of the robot's time, by part."""
    seconds = 5
    body = Body(load_world(WORLD))
    body.drive(0.05, 0.15)
    body.advance(1.0)
    sweeps, autopilot = LidarSweeps(body), AutopilotEmulator(body)
    sweeps.ranges(0.5)
    autopilot.due(1.0)

    def cost(name: str, work: Callable[[float], object]) -> None:
        begin, start = time.process_time(), body.time
        for k in range(1, 1000 * seconds + 1):
            work(start + k * 1e-3)
        print(f"  {name:32s}{(time.process_time() - begin) / seconds * 100:6.2f} %")

    cost("body, 1 ms steps", body.advance)
    cost("body and autopilot", lambda t: (body.advance(t), autopilot.due(t)))
    begin = time.process_time()
    for _ in range(50):
        sweeps.ranges(body.time - 0.2)
    print(f"  {'lidar, 10 sweeps a second':32s}{(time.process_time() - begin) / 5 * 100:6.2f} %")


def host(robot: VirtualRobot, seconds: float) -> tuple[dict[str, float], list[float]]:
    """Read all devices and drive for a time; return readings per s by type, and latencies in s."""
    counts: Counter[str] = Counter()
    tables = robot.devices().items()
    devices: dict[str, Device] = {
        name: build("device", {"label": name, **table}, name) for name, table in tables
    }

    def receive(reading: Reading) -> None:
        counts[type(reading.message).__name__] += 1

    for device in devices.values():
        device.start(receive)
    while any(device.health().state != "ok" for device in devices.values()):
        time.sleep(0.01)
    counts.clear()
    begin = time.monotonic()
    latencies = _drive(robot, devices["autopilot"], seconds)
    rates = {kind: number / (time.monotonic() - begin) for kind, number in sorted(counts.items())}
    for device in devices.values():
        device.stop()
    return rates, latencies


def _drive(robot: VirtualRobot, autopilot: Device, seconds: float) -> list[float]:
    assert isinstance(autopilot, DriveDevice)
    sent, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        # Each differs from the one before, so that its effect is visible.
        sent.append(time.monotonic())
        autopilot.drive(SPEED + 0.002 * (len(sent) % 2), TURN_RATE)
        time.sleep(1.0 / COMMANDS)
    changes = np.array([entry[0] for entry in robot.truth(since=sent[0])["commands"]])
    after = np.searchsorted(changes, sent)
    return [changes[i] - at for i, at in zip(after, sent, strict=True) if i < len(changes)]


def main() -> None:
    """Measure and print."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    print("share of one core, by part")
    parts()
    with VirtualRobot(WORLD) as robot:
        time.sleep(2.0)
        before = robot.status()
        begin = time.monotonic()
        rates, latencies = host(robot, seconds)
        after = robot.status()
        span = time.monotonic() - begin
    share = (after["cpu"] - before["cpu"]) / span
    late = {key: 1e3 * value for key, value in after["lateness"].items()}
    median, p99 = 1e3 * np.percentile(latencies, (50, 99))
    print(f"whole process over {span:.1f} s: {100 * share:.1f} % of one core")
    print(
        f"lateness of the loop, last 10 s: median {late['p50']:.2f} ms, p99 {late['p99']:.2f} ms, "
        f"most {late['max']:.1f} ms; {after['late'] - before['late']} passes later than 20 ms"
    )
    print(f"drive command to motors: median {median:.2f} ms, p99 {p99:.2f} ms of {len(latencies)}")
    heard = ", ".join(f"{kind} {rate:.1f}" for kind, rate in rates.items())
    print(f"heard by the host, per second: {heard}")
    for name, line in after["lines"].items():
        print(f"{name}: bytes {line}")


if __name__ == "__main__":
    main()
