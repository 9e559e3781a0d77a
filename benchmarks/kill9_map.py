"""Kills a robot that maps without warning, many times, and opens the map and the log that it leaves.

    python benchmarks/kill9_map.py [-n 100] [--seed 0] [--period 0.1]

A child process records and maps the simulated arena, three times as fast as real time, saves its map
every `period` s instead of every minute, and is killed (SIGKILL) at a random moment after the first
save; every second one then lives on until it next begins to write the file. The map must open and
hold what had been mapped at the save before the last; the log must open, too. Children are forked from
a process that has compiled the estimator.
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

FASTER = 3.0  # than real time
LATEST = 3.0  # s after the first save that a child is killed
WORLD = "arena"
FORK = multiprocessing.get_context("fork")


def live(folder: Path, period: float, said: Connection) -> None:
    """Record and map until killed; tell after each save how many scans are mapped."""
    map_keeper.SAVE_INTERVAL, map_keeper.MIN_PAUSE_RATIO = period, 0
    station = Station({}, "imp", folder, (0.5, 1.0), 0)
    save = station.mapper.save_map

    def told(where: Path) -> Path:
        path = save(where)
        said.send(station.mapper.status().steps)
        return path

    station.mapper.save_map = told  # type: ignore[method-assign]
    station.start()
    station.begin(record=True, map_=True)
    while station.mapper.status().state == "compiling":
        time.sleep(0.01)
    readings = [m for m in simulate(load_world(WORLD), seed=1) if not isinstance(m, TruePose)]
    begin, first = now(), readings[0].stamp
    for message in readings:
        time.sleep(max(0.0, begin + (message.stamp - first) / FASTER - now()))
        station._receive(Reading(message, now(), "robot"))
    time.sleep(60.0)


@dataclass(frozen=True)
class Left:
    """What a kill leaves: scans in the map, whether the file was being written, its bytes."""

    scans: int
    part: bool
    bytes: int
    fault: str = ""


def kill_once(seed: int, period: float) -> Left:
    """Kill a child and look at what it leaves."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="kill9-map-") as name:
        folder = Path(name)
        heard, said = FORK.Pipe(duplex=False)
        child = FORK.Process(target=live, args=(folder, period, said))
        child.start()
        said.close()
        told = [heard.recv()]
        time.sleep(rng.uniform(0.0, LATEST))
        if seed % 2:
            _wait_for_part(folder)
        child.kill()
        child.join()
        with contextlib.suppress(EOFError):
            while True:
                told.append(heard.recv())
        part = any(folder.glob(f"maps/*/.{FILE}.*.part"))
        try:
            known, size = _opened(folder)
            # What is told are the scans after a save: some may have come while it was written.
            before = told[-2] if len(told) > 1 else 1
            assert len(known.stamps) >= before, f"{len(known.stamps)} scans, {before} were saved"
        except (ImpError, ValueError, AssertionError) as error:
            return Left(0, part, 0, f"seed {seed}: {error}")
        return Left(len(known.stamps), part, size)


def _opened(folder: Path) -> tuple[Map, int]:
    """Return the map that is left and its bytes; an error if it or the log does not open."""
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
    """Kill, open, and print what was found."""
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
