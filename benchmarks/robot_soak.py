"""The whole virtual robot for half an hour, driven from a browser: losses and resource usage.

    python benchmarks/robot_soak.py [--minutes 30] [--chromium /usr/bin/chromium]

One process is the robot computer (station, page), one the virtual robot, and one a browser that maps,
records and drives round after round. Printed are: lost frames, by the devices' own numbers; whether every
scan was mapped or counted, and every reading written or counted; memory and CPU of each process over time;
the time from a scan's arrival to its drawing on the page; and the time from a key press in the browser to
the motor command.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

TICK = os.sysconf("SC_CLK_TCK")
PAGE_SIZE = os.sysconf("SC_PAGE_SIZE")
JOGS = 12  # keys pressed after each round, to time them
SAMPLE = 10.0  # s between looks at memory and CPU


def visit(link: str, minutes: float, chromium: str) -> None:
    """Drive from a browser until the time is over; print when keys are pressed."""
    from playwright.sync_api import sync_playwright  # noqa: PLC0415  # the robot needs it not
    from tests.platform.console.pilot import ARENA, FLAGS, Pilot  # noqa: PLC0415

    end = time.monotonic() + 60 * minutes
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(link)
        page.get_by_test_id("map").wait_for(timeout=30_000)
        page.get_by_test_id("map-start").click()
        page.wait_for_function(
            "Number(document.querySelector('[data-testid=map]').dataset.scans) > 5", timeout=120_000
        )
        page.get_by_test_id("record").click()
        page.get_by_test_id("take").click()
        pilot = Pilot(page)
        while time.monotonic() < end:
            pilot.drive([*ARENA, (0.1, 0.0)])
            time.sleep(0.5)
            for i in range(JOGS):
                key = "ad"[i % 2]  # to the left and back again
                print(f"press {time.monotonic()}", flush=True)
                page.keyboard.down(key)
                time.sleep(0.3)
                page.keyboard.up(key)
                time.sleep(0.4)
        page.get_by_test_id("record-stop").click()
        page.wait_for_timeout(1000)
        browser.close()


@dataclass
class Usage:
    """CPU and memory of a process (and its children) over time."""

    pid: int
    rows: list[tuple[float, float, float]] = field(default_factory=list)

    def look(self) -> None:
        cpu = memory = 0.0
        for pid in family(self.pid):
            with contextlib.suppress(OSError):
                fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                cpu += (int(fields[11]) + int(fields[12])) / TICK
                memory += int(fields[21]) * PAGE_SIZE / 1e6
        self.rows.append((time.monotonic(), cpu, memory))

    def told(self) -> str:
        rows = np.array(self.rows)
        third = max(len(rows) // 3, 1)
        busy = (rows[-1, 1] - rows[third, 1]) / (rows[-1, 0] - rows[third, 0])
        memory = [rows[third, 2], rows[2 * third, 2], rows[-1, 2]]
        growth = 3600 * np.polyfit(rows[third:, 0], rows[third:, 2], 1)[0]
        return (
            f"{100 * busy:5.1f} % of a core; memory after 1/3, 2/3, 3/3 of the time "
            f"{memory[0]:.0f}, {memory[1]:.0f}, {memory[2]:.0f} MB ({growth:+.1f} MB/h)"
        )


def family(pid: int) -> list[int]:
    """Return a process and its descendants, but not the virtual robot and the browser of this one."""
    found = [pid]
    if pid == os.getpid():
        return found
    for one in found:
        with contextlib.suppress(OSError):
            text = Path(f"/proc/{one}/task/{one}/children").read_text()
            found += [int(word) for word in text.split()]
    return found


class Watcher(threading.Thread):
    """Starts the browser, monitors it, and stops the server when the browser has ended."""

    def __init__(self, imp, options) -> None:
        super().__init__(daemon=True)
        self.imp, self.options = imp, options
        self.usage = {"robot computer": Usage(os.getpid()), "virtual robot": Usage(imp.pid)}
        self.link = threading.Event()
        self.address, self.presses, self.waits, self.latencies = "", [], [], []

    def ready(self, line: str) -> None:
        if line.startswith("open "):
            self.address = line.split()[1]
            self.link.set()

    def run(self) -> None:
        import signal  # noqa: PLC0415

        from impslam.platform.console import page  # noqa: PLC0415

        self.link.wait(60)
        words = [sys.executable, __file__, "--visit", self.address]
        words += ["--minutes", str(self.options.minutes), "--chromium", self.options.chromium]
        child = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self.usage["browser"] = Usage(child.pid)
        threading.Thread(target=self._listen, args=(child,), daemon=True).start()
        drawn = time.monotonic()
        while child.poll() is None:
            for usage in self.usage.values():
                usage.look()
            if time.monotonic() - drawn > 80.0:  # the page keeps the newest thousand: 100 s
                drawn = time.monotonic()
                self.latencies.append(page.latencies()[-800:])
            time.sleep(SAMPLE)
        self.latencies.append(page.latencies())
        os.kill(os.getpid(), signal.SIGINT)

    def _listen(self, child: subprocess.Popen[str]) -> None:
        """Query when each pressed key reached the motors."""
        for line in child.stdout:
            if not line.startswith("press "):
                continue
            pressed = float(line.split()[1])
            time.sleep(0.25)
            moved = [c for c in self.imp.truth(pressed)["commands"] if c[1] or c[2]]
            self.presses.append(pressed)
            if moved:
                self.waits.append(moved[0][0] - pressed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--visit", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.visit:
        visit(options.visit, options.minutes, options.chromium)
        return
    from impslam.platform.console.model import Model  # noqa: PLC0415
    from impslam.platform.console.server import ServerSettings, serve  # noqa: PLC0415
    from impslam.platform.station.robot_file import RobotFile  # noqa: PLC0415
    from impslam.platform.station.station import Station  # noqa: PLC0415
    from impslam.platform.virtual.process import VirtualRobot  # noqa: PLC0415
    from impslam.sources.rosbag import RosBag  # noqa: PLC0415

    logging.basicConfig(level=logging.WARNING)
    with tempfile.TemporaryDirectory() as folder, VirtualRobot("arena", 0) as imp:
        robot = RobotFile(devices=imp.devices())
        station = Station(robot.make_devices(), "imp", Path(folder), (0.5, 1.0), 0)
        station.start()
        begin = time.monotonic()
        watcher = Watcher(imp, options)
        watcher.start()
        settings = ServerSettings(port=0, accounts=Path(folder) / "accounts.json")
        serve(Model("imp", station.view, station=station), settings, ready=watcher.ready)
        seconds = time.monotonic() - begin
        health = {name: device.health() for name, device in station.devices.items()}
        mapping, lateness = station.mapper.status(), imp.status()
        station.stop()
        recorded = station.recorder.status()
        with RosBag(path=recorded.path) as source:
            topics = {stream.name: stream.count for stream in source.streams()}
            read = sum(len(columns) for batch in source.batches() for columns in batch.values())
            problems = dict(source.problems.counts)
    report(health, mapping, recorded, lateness, watcher)
    print(
        f"{seconds / 60:.1f} min; log: {sum(topics.values())} messages in {len(topics)} topics, "
        f"{read} read back; {problems}"
    )


def report(health, mapping, recorded, lateness, watcher) -> None:
    for name, state in health.items():
        print(f"{name}: {dict(sorted(state.counts.items()))}")
    scans = mapping.steps + mapping.dropped_scans + mapping.waiting
    print(f"mapper: {mapping.steps} mapped + {mapping.dropped_scans} dropped = {scans} scans")
    print(
        f"recorder: {sum(recorded.written.values())} written, {sum(recorded.dropped.values())} dropped; "
        f"{recorded.size / 1e6:.1f} MB in {recorded.seconds:.0f} s"
    )
    print(f"virtual robot: {lateness['late']} passes late, {lateness['lateness']}")
    for name, usage in watcher.usage.items():
        print(f"{name}: {usage.told()}")
    drawn = 1e3 * np.concatenate(watcher.latencies)
    print("scan to page: median {:.0f} ms, p99 {:.0f} ms".format(*np.percentile(drawn, (50, 99))))
    waits = 1e3 * np.array(watcher.waits)
    print(
        "key to motors: median {:.0f} ms, p99 {:.0f} ms".format(*np.percentile(waits, (50, 99)))
        + f" ({len(waits)} of {len(watcher.presses)} keys reached them)"
    )


if __name__ == "__main__":
    main()
