"""Every fault a hundred times on the virtual robot: recovery, its time, and the log.

    python benchmarks/robot_faults.py [-n 100] [--seed 0]

The station records and maps while faults occur on all devices at once, and the robot turns to and fro. A
device has recovered when ten consecutive messages have arrived at its usual rate after the fault; the time
is from the end of the fault (for a reboot, from its beginning). More than 20 s counts as hanging. At the
end the log is read: everything that was written must be there.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from impslam.errors import ImpError
from impslam.platform.devices.base import Device
from impslam.platform.station.robot_file import RobotFile
from impslam.platform.station.station import Station
from impslam.platform.virtual.process import VirtualRobot
from impslam.sources.rosbag import RosBag

RECOVERY_TIMEOUT = 20.0  # s
MESSAGE = {"autopilot": "WheelAngles", "lidar": "LaserScan", "camera": "Image"}
PERIOD = {"autopilot": 0.01, "lidar": 0.1, "camera": 0.2}
ROW = {"autopilot": 10, "lidar": 3, "camera": 2}  # messages in a row that are recovery

FAULTS: dict[str, dict[str, dict[str, Any]]] = {
    "autopilot": {
        "noise 1 % of bytes, 0.3 s": {"fault": "noise", "rate": 0.01, "seconds": 0.3},
        "noise 30 % of bytes, 0.3 s": {"fault": "noise", "rate": 0.3, "seconds": 0.3},
        "unplug 0.5 s": {"fault": "unplug", "seconds": 0.5},
        "held back 0.5 s": {"fault": "delay", "seconds": 0.5},
        "reboot": {"fault": "reboot"},
    },
    "lidar": {
        "noise 0.1 % of bytes, 0.3 s": {"fault": "noise", "rate": 0.001, "seconds": 0.3},
        "noise 30 % of bytes, 0.3 s": {"fault": "noise", "rate": 0.3, "seconds": 0.3},
        "unplug 0.5 s": {"fault": "unplug", "seconds": 0.5},
        "held back 0.5 s": {"fault": "delay", "seconds": 0.5},
        "reboot": {"fault": "reboot"},
    },
    "camera": {
        "unplug 0.5 s": {"fault": "unplug", "seconds": 0.5},
        "frozen 0.5 s": {"fault": "delay", "seconds": 0.5},
    },
}


class Watch:
    """Records the arrival times of the messages of a device."""

    def __init__(self, device: Device, kind: str) -> None:
        self._device, self._kind = device, kind

    def count(self) -> int:
        return self._device.health().counts.get(self._kind, 0)

    def recovery(self, since: float, row: int, period: float) -> float:
        """Return s from `since` (monotonic) until the first of `row` messages at the usual rate."""
        seen, first, last = self.count(), since, time.monotonic()
        got = 0
        while time.monotonic() - since < RECOVERY_TIMEOUT:
            time.sleep(0.002)
            count, moment = self.count(), time.monotonic()
            if count > seen:
                if got == 0 or moment - last > 3 * period + 0.05:
                    got, first = 0, moment
                got += count - seen
                seen, last = count, moment
                if got >= row:
                    return max(first - since, 0.0)
        return float("nan")


def torment(imp: VirtualRobot, device: Device, name: str, times: int, seed: int, out: dict) -> None:
    rng = np.random.default_rng(seed)
    watch = Watch(device, MESSAGE[name])
    for _ in range(times):
        for title, fault in FAULTS[name].items():
            time.sleep(float(rng.uniform(0.1, 0.4)))
            imp.fault(device=name, **fault)
            time.sleep(fault.get("seconds", 0.0))
            took = watch.recovery(time.monotonic(), ROW[name], PERIOD[name])
            out[name, title].append(took)
            if not np.isfinite(took):
                print(
                    f"HANGS: {name}: {title}: {device.health()}",
                    file=sys.stderr,
                    flush=True,
                )


def turn(station: Station, imp: VirtualRobot, times: int, seed: int, out: dict, stop) -> None:
    """Drive to and fro, and block the motors at times: they must respond again afterwards."""
    rng = np.random.default_rng(seed)
    station.drive_control.take("benchmark", "benchmark")
    stalls = 0
    sign, due, next_stall, healed = 1.0, 0.0, time.monotonic() + 2.0, None
    while not stop.is_set():
        moment = time.monotonic()
        if moment > due:
            sign, due = -sign, moment + 3.0
        if stalls < times and moment > next_stall and healed is None:
            side = str(rng.choice(["left", "right", "both"]))
            imp.fault("stall", side=side, seconds=0.5)
            stalls, healed = stalls + 1, moment + 0.5
        station.drive_control.drive("benchmark", 0.0, 0.5 * sign)
        if healed is not None and moment > healed:
            motors = np.abs(imp.truth(moment)["motors"])
            if motors.min() > 0.03:
                out["motors", "stall 0.5 s"].append(moment - healed)
                healed, next_stall = None, moment + float(rng.uniform(0.5, 2.0))
            elif moment - healed > RECOVERY_TIMEOUT:
                out["motors", "stall 0.5 s"].append(float("nan"))
                healed, next_stall = None, moment + 1.0
        time.sleep(0.05)


def read(log: Path) -> tuple[dict[str, int], dict[str, int]]:
    with RosBag(path=log) as source:
        counts = {stream.name: stream.count or 0 for stream in source.streams()}
        for _ in source.batches():
            pass
        return counts, dict(source.problems.counts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.basicConfig(level=logging.CRITICAL)
    out: dict[tuple[str, str], list[float]] = defaultdict(list)
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, VirtualRobot("arena", options.seed) as imp:
        robot = RobotFile(devices=imp.devices())
        station = Station(robot.make_devices(), "imp", Path(folder), (0.5, 1.0), 0)
        station.start()
        station.start_mapping()
        log = station.recorder.start("faults")
        while not all(d.health().state == "ok" for d in station.devices.values()):
            time.sleep(0.1)
        time.sleep(2.0)
        stop = threading.Event()
        threads = [
            threading.Thread(
                target=torment,
                args=(imp, station.devices[name], name, options.n, options.seed + i, out),
            )
            for i, name in enumerate(FAULTS)
        ]
        driver = threading.Thread(
            target=turn, args=(station, imp, options.n, options.seed, out, stop)
        )
        for thread in (*threads, driver):
            thread.start()
        for thread in threads:
            thread.join()
        stop.set()
        driver.join()
        status = station.recorder.status()
        mapping = station.mapper.status()
        health = {name: device.health() for name, device in station.devices.items()}
        begin_stop = time.monotonic()
        station.stop()
        stopping = time.monotonic() - begin_stop
        try:
            counts, problems = read(log)
        except ImpError as error:
            print(f"THE LOG CANNOT BE READ: {error}")
            raise SystemExit(1) from None
        written = station.recorder.status().written
    print(f"in {time.monotonic() - begin:.0f} s; stopping the station took {stopping:.2f} s")
    print(f"log: {sum(counts.values())} messages, {sum(written.values())} written; {problems}")
    report(out, status, mapping, health)


def report(out, status, mapping, health) -> None:
    print(
        f"{'device':10} {'fault':28} {'times':>5} {'hung':>4} {'median':>8} {'p90':>7} {'worst':>7}"
    )
    for (name, title), times in out.items():
        values = np.array(times)
        good = values[np.isfinite(values)]
        p50, p90, worst = np.percentile(good, (50, 90, 100)) if len(good) else [np.nan] * 3
        hung = len(values) - len(good)
        print(
            f"{name:10} {title:28} {len(values):5d} {hung:4d} {p50:6.2f} s {p90:5.2f} s {worst:5.2f} s"
        )
    print(f"recorder: dropped {dict(status.dropped)}, error {status.error!r}")
    print(f"mapper: {mapping.state}, {mapping.steps} scans, dropped {mapping.dropped_scans}")
    for name, state in health.items():
        print(f"{name}: {dict(sorted(state.counts.items()))}")


if __name__ == "__main__":
    main()
