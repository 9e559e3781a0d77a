"""Kill a mapping robot without warning, many times, and open the map and the log that remain.

    python benchmarks/kill9_map.py [-n 100] [--seed 0] [--period 0.1]

A child process records and maps the simulated arena, three times as fast as real time, saves its map every
`period` s instead of every minute, and is killed (SIGKILL) at a random moment after the first save; every
second one is killed at its next write of the file. The map must open and contain everything mapped at the
save before the last; the log must open, too. Children are forked from a process that has compiled the
estimator.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import sys
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from impslam.config import load
from impslam.errors import ImpError
from impslam.map import Map
from impslam.platform.devices.base import Reading, now
from impslam.platform.station import map_keeper
from impslam.platform.station.map_store import FILE, MapStore
from impslam.platform.station.station import Station
from impslam.platform.station.warm_up import warm_up
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.base import recognise
from impslam.types import TruePose

SPEEDUP = 3.0  # over real time
MAX_DELAY = 3.0  # s after the first save until a child is killed
WORLD = "arena"
FORK = multiprocessing.get_context("fork")


def live(folder: Path, period: float, sender: Connection) -> None:
    """Record and map until killed; after each save, send the number of mapped scans."""
    map_keeper.SAVE_INTERVAL, map_keeper.MIN_PAUSE_RATIO = period, 0
    station = Station({}, "imp", folder, (0.5, 1.0), 0)
    save = station.mapper.save_map

    def save_and_report(where: Path) -> Path:
        path = save(where)
        sender.send(station.mapper.status().steps)
        return path

    station.mapper.save_map = save_and_report
    station.start()
    station.begin(record=True, map_=True)
    while station.mapper.status().state == "compiling":
        time.sleep(0.01)
    readings = [m for m in simulate(load_world(WORLD), seed=1) if not isinstance(m, TruePose)]
    begin, first = now(), readings[0].stamp
    for message in readings:
        time.sleep(max(0.0, begin + (message.stamp - first) / SPEEDUP - now()))
        station.receive(Reading(message, now(), "robot"))
    time.sleep(60.0)


@dataclass(frozen=True)
class Left:
    """Remains of a killed robot: scans in the map, whether the file was being written, its bytes."""

    scans: int
    part: bool
    bytes: int
    fault: str = ""


def kill_once(seed: int, period: float) -> Left:
    """Kill a child and check what remains."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="kill9-map-") as name:
        folder = Path(name)
        receiver, sender = FORK.Pipe(duplex=False)
        child = FORK.Process(target=live, args=(folder, period, sender))
        child.start()
        sender.close()
        counts = [receiver.recv()]
        time.sleep(rng.uniform(0.0, MAX_DELAY))
        if seed % 2:
            _wait_for_part(folder)
        child.kill()
        child.join()
        with contextlib.suppress(EOFError):
            while True:
                counts.append(receiver.recv())
        part = any(folder.glob(f"maps/*/.{FILE}.*.part"))
        try:
            known, size = _opened(folder)
            # The count is taken after a save: some scans may have come while it was written.
            before = counts[-2] if len(counts) > 1 else 1
            assert len(known.stamps) >= before, f"{len(known.stamps)} scans, {before} were saved"
        except (ImpError, ValueError, AssertionError) as error:
            return Left(0, part, 0, f"seed {seed}: {error}")
        return Left(len(known.stamps), part, size)


def _opened(folder: Path) -> tuple[Map, int]:
    """Return the remaining map and its bytes; raise an error if it or the log does not open."""
    (one,) = MapStore(folder / "maps").maps()
    known = Map.load(folder / "maps" / one.name / FILE)
    assert np.isfinite(known.path()).all(), "the path is not finite"
    (log,) = folder.glob("*.mcap")
    with recognise(log)(path=log) as source:
        for _ in source.batches():
            pass
    return known, one.size


def _wait_for_part(folder: Path) -> None:
    end = time.monotonic() + 10.0
    while time.monotonic() < end and not any(folder.glob(f"maps/*/.{FILE}.*.part")):
        pass


def main() -> None:
    """Kill, open, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=100, help="how often to kill")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--period", type=float, default=0.1, help="s between two saves")
    chosen = parser.parse_args()
    warm_up(load("imp"))
    seeds = range(chosen.seed, chosen.seed + chosen.n)
    left = [kill_once(seed, chosen.period) for seed in seeds]
    faults = [one.fault for one in left if one.fault]
    for fault in faults:
        print(fault)
    scans, size = ([getattr(one, name) for one in left] for name in ("scans", "bytes"))
    print(
        f"{chosen.n} kills: {chosen.n - len(faults)} maps and logs open; {sum(o.part for o in left)} "
        f"while the file was written; {min(scans)} to {max(scans)} scans, up to {max(size) / 1e6:.1f} MB"
    )
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
