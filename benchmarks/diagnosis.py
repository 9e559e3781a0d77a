"""Detection of faults in logs: each fault, in several sizes, injected into several logs.

    python -m benchmarks.diagnosis --data FOLDER [--only NAME]

For each fault and size: the number of logs in which it is found (as a problem, or as a note if a run
tolerates it), the number of these in which the printed settings fix it (with them neither it nor another
problem remains), and other reported problems. Then the findings in sound logs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from tests import log_faults as faults

from impslam.columns import Batch, Columns, batches
from impslam.config import load
from impslam.diagnosis.diagnose import SCANS, diagnose
from impslam.diagnosis.finding import Finding
from impslam.diagnosis.head import Head
from impslam.open_log import open_log
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan

WRAPS = "encoder wraps"
AT_LIMIT = "98 % of range_max"
FEWER = 1500
"""Scans that faults are injected into."""
WORLDS = ("arena", "office")
LOGS = (
    ("turtlebot3/turtlebot3.bag", "turtlebot3-waffle"),
    ("turtlebot3/turtlebot3.bag", None),
    ("urg04lx-encoders/exp1.dat", None),
    ("lego-robot4", None),
    ("intel/intel.log", None),
    ("fr079/fr079.log", None),
)
SOUND = (
    *LOGS,
    ("urg04lx-encoders/exp2.dat", None),
    ("urg04lx-encoders/test_lab2.dat", None),
    ("fr-hospital/fr-hospital.log", None),
    ("fr101/fr101.recovered.log", None),
    ("carpark", None),
    ("victoria-park", None),
    ("mrclam6", None),
    ("kf-demo/kf-slam_demo.txt", None),
)


@dataclass(frozen=True)
class Log:
    """The beginning of a log, and the config that fits it."""

    name: str
    preset: str
    batches: list[Batch]
    defaults: dict

    def found(self, change: faults.Change, settings: Iterable[str] = ()) -> list[Finding]:
        config = load(self.preset, list(settings))
        return diagnose(config, list(faults.faulty(self.batches, change)), self.defaults)

    @property
    def odometry(self):
        return load(self.preset).make_robot().odometry

    @property
    def range_max(self) -> float:
        """Return the limit of ranges, of the config and the messages, m."""
        return float(np.fmin(self.lidar.range_max, self.first_scans["range_max"]))

    @property
    def sweep(self) -> float:
        """Return the duration of a sweep, s."""
        return float(self.first_scans["time_offsets"].max())

    @property
    def first_scans(self) -> Columns:
        """Return the first rows of the lidar."""
        return next(c for batch in self.batches for c in batch.values() if c.kind is LaserScan)

    @property
    def lidar(self):
        return next(iter(load(self.preset).make_robot().sensors.values()))


@dataclass(frozen=True)
class Fault:
    """A fault of some size: a change of the rows, or wrong settings.

    `kinds` are the findings that name it. `needs` is the odometry that can have it.
    """

    name: str
    size: str
    kinds: tuple[str, ...]
    change: Callable[[], faults.Change] = faults.nothing
    settings: Callable[[Log], list[str]] = lambda _: []
    needs: tuple[str, ...] = ("encoders", "odometry_pose")
    mounted: bool = False
    """Whether the preset must contain the mount."""
    unsmoothed: bool = False
    """Whether the preset must leave stamps as they are."""
    sweeps: bool = False
    """Whether the lidar must measure its beams one after the other."""
    back: bool = False
    """Whether the drive must go back again."""

    def applies_to(self, log: Log) -> bool:
        given = "mount" in next(iter(load(log.preset).sensors.values()))
        if (self.unsmoothed and log.lidar.period) or (self.sweeps and not log.sweep):
            return False
        return log.odometry.name in self.needs and (given or not self.mounted)


def of_setting(key: str, factor: float) -> Callable[[Log], list[str]]:
    """Return a wrong parameter of odometry."""
    return lambda log: [f"odometry.{key}={getattr(log.odometry, key) * factor:.6g}"]


def displaced(by: float) -> Callable[[Log], list[str]]:
    def settings(log: Log) -> list[str]:
        x, y, yaw = log.lidar.mount
        return [f"sensors.lidar.mount=[{x + by:.3f},{y},{yaw}]"]

    return settings


WHEELS, POSES = ("encoders",), ("odometry_pose",)


def of_scans() -> Iterator[Fault]:
    """Yield faults of beams and mounts."""
    yield Fault("scan mirrored", "", ("scan mirrored",), faults.mirrored)
    for d in (5, 20, 90, 180):
        change = partial(faults.turned, d / 57.29578)
        yield Fault("lidar rotated", f"{d}°", ("lidar rotated",), change)
    for m in (0.1, 0.3):
        name = "lidar displaced"
        yield Fault(name, f"{m} m", (name,), settings=displaced(m), mounted=True)
    for size in ("3 m", AT_LIMIT):
        name = "value for no return"
        yield Fault(name, size, (name,), partial(faults.no_return, 3.0))
    for d in (5, 30):
        yield Fault(
            "own body in view", f"{d}°", ("own body in view",), partial(faults.body, d / 57.3)
        )
    yield Fault("dead sector", "20°", ("dead sector",), partial(faults.blocked, 20 / 57.3))
    for x in (0.7, 0.9, 1.1):
        change = partial(faults.scaled_ranges, x)
        yield Fault("range scale", f"{x - 1:+.0%}", ("range scale", "odometry scale"), change)

    for m in (-0.1, 0.05, 0.1, 0.2):
        name, change = "range offset", partial(faults.longer_ranges, m)
        yield Fault(name, f"{m:+g} m", (name,), change)
    for share in (-0.1, 0.05, 0.1):
        name, change = "field of view", partial(faults.wider_field, 1.0 + share)
        yield Fault(name, f"{share:+.0%}", (name,), change)


def of_stamps() -> Iterator[Fault]:
    """Yield faults of clocks."""
    for s in (-0.3, 0.1, 0.3):
        yield Fault("stamps late", f"{s} s", ("stamps late",), partial(faults.late, s))
    for s in (0.01, 0.02, 0.04):
        name, change = "stamps jitter", partial(faults.jitter, s)
        yield Fault(name, f"{s} s", (name,), change, unsmoothed=True)
    for s in (0.5, 60.0):
        yield Fault("sweep too long", f"{s:g} s", ("sweep too long",), partial(faults.sweep_of, s))
    name, change = "sweep time wrong", partial(faults.sweep_of, 0.0)
    yield Fault(name, "0 s", (name,), change, sweeps=True)
    name = "sweep reversed"
    yield Fault(name, "", (name,), faults.reversed_sweep, sweeps=True)


def of_odometry() -> Iterator[Fault]:
    """Yield faults of odometry of any kind, and of poses."""
    yield Fault("odometry stands still", "", ("odometry stands still",), faults.standing)
    yield Fault("odometry stops", "10 s", ("odometry stops",), partial(faults.stopping, 20.0, 10.0))
    name = "odometry unsigned"
    yield Fault(name, "", (name,), faults.unsigned, needs=POSES, back=True)
    for way, turn in ((0.8, 0.8), (1.0, 0.7)):
        name, change = "odometry scale", partial(faults.scaled_odometry, way, turn)
        yield Fault(name, f"{way:g}, {turn:g}", (name,), change, needs=POSES)


def of_wheels() -> Iterator[Fault]:
    """Yield faults of encoders and wheels."""
    swapped = ("wheels swapped", "scan mirrored")
    yield Fault("wheels swapped", "", swapped, faults.swapped, needs=WHEELS)
    for side in ("left", "right"):
        change = partial(faults.reversed_wheels, side)
        yield Fault("wheel reversed", side, ("wheel reversed",), change, needs=WHEELS)
    change = partial(faults.reversed_wheels, "left", "right")
    yield Fault("wheels reversed", "both", ("wheels reversed",), change, needs=WHEELS)
    parameters = {
        "wheel radius": "wheel_radius",
        "track": "track",
        "wheels unequal": "right_left_ratio",
    }
    for name, key in parameters.items():
        for share in (0.1, 0.3):
            settings = of_setting(key, 1.0 + share)
            yield Fault(name, f"{share:+.0%}", (name,), settings=settings, needs=WHEELS)
    yield Fault(WRAPS, "3 turns", (WRAPS,), needs=WHEELS)


def injected(fault: Fault, log: Log) -> faults.Change:
    """Return the change of a log; some sizes depend on the robot."""
    if fault.name == WRAPS:
        return faults.wrapping(3.0 * log.odometry.per_turn)
    if fault.size == AT_LIMIT:
        return faults.no_return(0.98 * log.range_max)
    return fault.change()


def of_world(name: str) -> Log:
    messages = simulate(load_world(name), seed=1)
    return Log(name, "imp", list(batches((type(m).__name__, m) for m in messages)), {})


def of_file(data: Path, path: str, preset: str | None, scans: int = SCANS) -> Log:
    _, source = open_log(data / path, preset)
    with source:
        head = Head(scans)
        list(head.read(source.batches()))
        chosen = preset or source.preset
        name = path.rsplit("/", maxsplit=1)[-1].split(".", maxsplit=1)[0]
        return Log(f"{name} ({chosen})", chosen, head.batches, dict(source.defaults()))


@dataclass
class Row:
    """Results of a fault in several logs, with the names of logs with other results."""

    logs: int = 0
    problems: int = 0
    notes: int = 0
    fixes: int = 0
    missed: list[str] = field(default_factory=list)
    unmended: list[str] = field(default_factory=list)
    others: list[str] = field(default_factory=list)

    def add(self, log: Log, fault: Fault) -> None:
        self.logs += 1
        wrong = fault.settings(log)
        found = log.found(injected(fault, log), wrong)
        named = [one for one in found if one.kind in fault.kinds]
        self.others += [
            f"{log.name}: {one.kind}" for one in found if one.harmful and one not in named
        ]
        if not named:
            self.missed.append(log.name)
            return
        self.problems += named[0].harmful
        self.notes += not named[0].harmful
        left = log.found(injected(fault, log), [*wrong, *named[0].fix])
        bad = [one for one in left if one.harmful or one.kind in fault.kinds]
        self.fixes += bool(named[0].fix)
        if named[0].fix and bad:
            self.unmended.append(f"{log.name}: {', '.join(one.kind for one in bad)}")

    def cells(self) -> list[str]:
        mended = f"{self.fixes - len(self.unmended)} of {self.fixes}"
        numbers = [self.logs, self.problems, self.notes, mended]
        names = ("; ".join(some) or "-" for some in (self.missed, self.unmended, self.others))
        return [*map(str, numbers), *names]


def table(known: Sequence[Log], only: str) -> None:
    print(
        "| fault | size | logs | problem | note | mended | missed | not mended | other problems |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for fault in chain(of_scans(), of_stamps(), of_odometry(), of_wheels()):
        if only not in fault.name:
            continue
        row = Row()
        for log in known:
            if fault.applies_to(log):
                drive = Log(log.name, log.preset, faults.there_and_back(log.batches), log.defaults)
                row.add(drive if fault.back else log, fault)
        print(f"| {fault.name} | {fault.size} | {' | '.join(row.cells())} |", flush=True)


def sound(known: Iterable[Log]) -> None:
    print("\n| sound log | problems | notes |\n|---|---|---|")
    for log in known:
        found = log.found(faults.nothing())
        harm = "; ".join(one.what for one in found if one.harmful)
        notes = "; ".join(one.what for one in found if not one.harmful)
        print(f"| {log.name} | {harm or '-'} | {notes or '-'} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", default="", help="a part of the names of faults")
    parser.add_argument("--sound", action="store_true", help="the sound logs alone")
    options = parser.parse_args()
    simulated = [of_world(name) for name in WORLDS]
    if not options.sound:
        table(
            [*simulated, *(of_file(options.data, path, preset, FEWER) for path, preset in LOGS)],
            options.only,
        )
    sound([*simulated, *(of_file(options.data, path, preset) for path, preset in SOUND)])


if __name__ == "__main__":
    main()
