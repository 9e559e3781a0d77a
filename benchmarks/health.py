"""Reliability of a run's health: kidnapped robots, faults, and clean logs.

    python -m benchmarks.health --data ../shared/data --runs 30 --buildings 100 --faults 3

A kidnapping joins two pieces of a log: the robot maps up to a sweep, is carried, without motion of
odometry, to a later sweep in surroundings that it has mapped, and drives on. This is also done in random
buildings (see `random_buildings`), each once. The faults change the sweeps
of 10 s. Truth is that of the simulator, or for a recorded log the map of the whole log, so that ellipses
cannot be tested with it. Clean logs show the rate of false reports.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np
from benchmarks.random_buildings import nominal, random_robot, random_world

from impslam.columns import Motions, Sweeps, batches
from impslam.config import Config, load
from impslam.geometry.chi_square import GATE_3D_99, GATE_3D_999
from impslam.geometry.se2 import between, compose, inverse
from impslam.health import ELSEWHERE, LOST, NONE, TRACKING, UNEXPLAINED, Health
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer
from impslam.open_log import open_log
from impslam.run import Run
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Array, Message, TruePose

SIMULATED, BUILDING = "corridor, simulated", "random building"
LOGS = {"intel": "intel/intel.log", "fr079": "fr079/fr079.log"}
CLEAN = {
    **LOGS,
    "exp1": "urg04lx-encoders/exp1.dat",
    "exp2": "urg04lx-encoders/exp2.dat",
    "test_lab2": "urg04lx-encoders/test_lab2.dat",
    "turtlebot3": "turtlebot3/turtlebot3.bag",
    "fr-hospital (outdoors, too)": "fr-hospital/fr-hospital.log",
}
PLAIN = [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "cylinders", "corners")]
GRAPH = ["tracker.kind=scan_to_map", "estimator.kind=graph"]
SWEEPS_AFTER = 1000  # sweeps after a kidnapping: 100 to 200 s
MAPPED_RADIUS = 1.5  # m: poses this close to the previous path are in mapped surroundings
SECONDS = 10.0  # of a fault
MAX_ERROR = 0.5  # m: a pose with a larger error and no report is a silent failure
KIDNAPPED = (
    *("kidnapped in", "runs", "first scan suspected", "LOST within 1 s", "median / worst"),
    *("found again", "after", "wrongly", "off after / before", "scans that entered the map"),
)
FAILED = (
    *("fault", "log", "runs", "scans not TRACKING", "off at worst, 20 s later"),
    *("TRACKING inside 99 %", "silent runs"),
)
Pairs = list[tuple[Motions, Sweeps]]


class Log(NamedTuple):
    """A log in sweeps, one a pair; stamps (n,) s and true poses (n, 3) of them."""

    config: Config
    pairs: Pairs
    stamps: Array
    poses: Array


class Live(Observer):
    """Stores each pose as known at its time."""

    def __init__(self) -> None:
        self.rows: list[PathRows] = []

    def follow(self, track: Track, path: PathRows) -> None:
        self.rows.append(path)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        self.rows.append(path)


class Result(NamedTuple):
    """A run: the refined map, health, and the live path with covariances."""

    known: Map
    health: Health
    poses: Array
    covariances: Array


def mapped(config: Config, pairs: Pairs) -> Result:
    """Map some sweeps."""
    live = Live()
    run = Run(config, observers=[live])
    run._track(pairs)
    poses, covariances = (
        np.concatenate([getattr(r, name) for r in live.rows]) for name in ("poses", "covariances")
    )
    return Result(run.refined(), run._health.health, poses, covariances)


def rows_of(sensed: Pairs) -> Pairs:
    """Return sweeps one by one."""
    return [
        (motions.take(slice(k, k + 1)), sweeps.take(slice(k, k + 1)))
        for motions, sweeps in sensed
        for k in range(len(sweeps))
    ]


@cache
def read(data: Path, name: str, seed: int = 0) -> Log:
    """Read a log and map it, or simulate it."""
    if name == SIMULATED:
        return corridor(seed)
    config, source = open_log(data / CLEAN[name], None, PLAIN)
    robot, sensed = config.make_robot(), []
    with source:
        for batch in robot.streams.read(source):
            sensed += robot.sense(batch)
        sensed += robot.flush()
    pairs = rows_of(sensed)
    known = mapped(config, pairs).known
    return Log(config, pairs, known.stamps, known.path()[:, 1:])


def corridor(seed: int) -> Log:
    """Simulate the shipped corridor with doors, clutter and people, out and back."""
    world = load_world("corridor")
    config = load("imp", [*PLAIN, *GRAPH, f"start={list(map(float, world.robot.start))}"])
    return sensed(config, simulate(world, SimulatedRobot(imu=None), seed=seed))


def building(seed: int) -> Log:
    """Simulate a random robot in a random building."""
    rng = np.random.default_rng(seed)
    world, (_, robot) = random_world(rng), random_robot(rng)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(nominal(robot))
        config = load(str(path), PLAIN)
    return sensed(config, simulate(world, robot, seed))


def sensed(config: Config, simulation: Iterable[Message]) -> Log:
    """Return the sweeps of a simulated drive with their true poses."""
    messages, robot = list(simulation), config.make_robot()
    parts = [
        pair
        for batch in batches((type(m).__name__, m) for m in messages)
        for pair in robot.sense(batch)
    ]
    pairs = rows_of([*parts, *robot.flush()])
    stamps = np.array([sweeps.columns.stamps[0] for _, sweeps in pairs])
    truth = np.array([[m.stamp, *m.pose] for m in messages if isinstance(m, TruePose)])
    columns = (*truth[:, 1:3].T, np.unwrap(truth[:, 3]))
    poses = np.column_stack([np.interp(stamps, truth[:, 0], column) for column in columns])
    return Log(config, pairs, stamps, poses)


class Kidnapping(NamedTuple):
    """Result of a kidnapping.

    Attributes
    ----------
    suspected : whether the first scan after it is not trusted
    seconds : until LOST was said, inf if it never was
    metres : of way until it was found again, inf if it never was
    off, before : m, the medians of what the refined poses after and before it are off by
    entered : scans between the jump and LOST that are in the map
    """

    suspected: bool
    seconds: float
    metres: float
    off: float
    before: float
    entered: int


def places(log: Log, after: int, rng: np.random.Generator) -> tuple[int, int]:
    """Return two sweeps, far apart in space; the second begins a path that was mapped before the first."""
    n = len(log.poses)
    for _ in range(100_000):
        i = int(rng.integers(n // 3, 2 * n // 3))
        j = int(rng.integers(i + 100, n))
        d = between(log.poses[i], log.poses[j])
        known, later = log.poses[:i:10, :2], log.poses[j : j + after // 2 : 20, :2]
        near = np.hypot(*(later[:, None] - known).transpose(2, 0, 1)).min(axis=1) < MAPPED_RADIUS
        far = np.hypot(*d[:2]) > 2.0 or (np.hypot(*d[:2]) > 0.5 and abs(d[2]) > 1.0)
        if j + after < n and far and near.mean() > 0.7 and near[0]:
            return i, j
    raise ValueError("the log has no two such places")


def kidnap(task: tuple[Path, str, int]) -> Kidnapping:
    """Carry a robot from one place to another, and score its reported health."""
    data, name, seed = task
    log = building(seed) if name == BUILDING else read(data, name, seed % 4)
    after = min(SWEEPS_AFTER, len(log.pairs) // 4)
    i, j = places(log, after, np.random.default_rng([seed, 11]))
    motions, sweeps = log.pairs[j]
    jump = motions._replace(d_pose=np.zeros((1, 3)), duration=np.full(1, 0.2)), sweeps
    result = mapped(log.config, [*log.pairs[:i], jump, *log.pairs[j + 1 : j + after]])
    states = result.health.states[i:]
    truth, poses = log.poses[np.r_[0:i, j : j + after]], np.full((i + after, 3), np.nan)
    poses[result.known.placed()] = result.known.path()[:, 1:]
    off = np.hypot(*(compose(compose(truth[0], inverse(poses[0])), poses) - truth)[:, :2].T)
    lost = np.flatnonzero(states == LOST)
    first = int(lost[0]) if len(lost) else after - 1
    found = first + np.flatnonzero(states[first:] == TRACKING)
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(truth[i:, :2], axis=0).T))))
    keys = result.known.keyframes
    ids = np.flatnonzero(np.isin(keys.stamps, log.stamps[j : j + first]))
    return Kidnapping(
        bool(result.health.reasons[i] != NONE),
        float(log.stamps[j + first] - log.stamps[j]) if len(lost) else np.inf,
        float(way[found[0]]) if len(found) else np.inf,
        float(np.median(off[i + first :])) if len(found) else np.nan,
        float(np.median(off[:i])),
        int((np.diff(keys.starts)[ids] > 0).sum()) if first else 0,
    )


def blocked(pair: tuple[Motions, Sweeps]) -> tuple[Motions, Sweeps]:
    """Cover 40 % of the beams at 0.4 m."""
    motions, sweeps = pair
    scans = sweeps.scans
    n = scans.ranges.shape[1]
    ranges, points, valid = scans.ranges.copy(), scans.points.copy(), scans.valid.copy()
    cover = slice(n // 4, n // 4 + (2 * n) // 5)
    ranges[:, cover], valid[:, cover] = 0.4, True
    directions = np.stack((np.cos(scans.directions), np.sin(scans.directions)), axis=-1)
    points[:, cover] = (scans.origins + 0.4 * directions)[:, cover]
    return motions, replace(sweeps, scans=replace(scans, ranges=ranges, points=points, valid=valid))


def moved(scale: float, pair: tuple[Motions, Sweeps]) -> tuple[Motions, Sweeps]:
    """Scale the motion of odometry."""
    motions, sweeps = pair
    return motions._replace(d_pose=scale * motions.d_pose), sweeps


def against_a_wall(log: Log, begin: int, seconds: float) -> tuple[Pairs, Array]:
    """Return sweeps and true poses with a stop at a sweep, while the wheels turn at 0.3 m/s."""
    motions, sweeps = log.pairs[begin]
    period, rng, stay = 0.1, np.random.default_rng(begin), []
    told = motions._replace(
        d_pose=np.array([[0.3 * period, 0.0, 0.0]]), duration=np.full(1, period)
    )
    for _ in range(int(seconds / period)):
        scans = sweeps.scans
        noise = 0.01 * rng.standard_normal(scans.ranges.shape)
        directions = np.stack((np.cos(scans.directions), np.sin(scans.directions)), axis=-1)
        noisy = replace(
            scans, ranges=scans.ranges + noise, points=scans.points + noise[..., None] * directions
        )
        stay.append((told, replace(sweeps, scans=noisy)))
    pairs = [*log.pairs[: begin + 1], *stay, *log.pairs[begin + 1 :]]
    return pairs, np.insert(log.poses, begin + 1, np.tile(log.poses[begin], (len(stay), 1)), axis=0)


FAULTS: dict[str, Callable[[tuple[Motions, Sweeps]], tuple[Motions, Sweeps]] | None] = {
    "none": lambda pair: pair,
    "40 % of the beams blocked": blocked,
    "odometry frozen": lambda pair: moved(0.0, pair),
    "wheels slip, twice the way": lambda pair: moved(2.0, pair),
    "wheels slip, half of the way": lambda pair: moved(0.5, pair),
    "wheels turn against a wall": None,
}


class Faulty(NamedTuple):
    """Result of a fault.

    Attributes
    ----------
    said : share of the scans of the fault that are not TRACKING
    worst, end : m, what the live path is off by at most from the fault on, and 20 s after it
    inside : share of all TRACKING scans inside their 99 % ellipse
    silent : scans that are off by more than `MAX_ERROR` and outside their 99.9 % ellipse while TRACKING
    """

    said: float
    worst: float
    end: float
    inside: float
    silent: int


def fail(task: tuple[Path, str, str, int]) -> Faulty:
    """Run a log with a fault of `SECONDS` at a random time."""
    data, name, fault, seed = task
    log = building(seed) if name == BUILDING else read(data, name, seed)
    rng = np.random.default_rng([seed, 12])
    begin = int(rng.integers(len(log.pairs) // 5, 4 * len(log.pairs) // 5))
    rows = max(1, int(SECONDS / np.median(np.abs(np.diff(log.stamps)))))
    change, truth = FAULTS[fault], log.poses
    if change is None:
        pairs, truth = against_a_wall(log, begin, SECONDS)
        rows = int(SECONDS / 0.1)
    else:
        middle = [change(pair) for pair in log.pairs[begin : begin + rows]]
        pairs = [*log.pairs[:begin], *middle, *log.pairs[begin + rows :]]
    result = mapped(log.config, pairs)
    d = between(compose(truth[0], compose(inverse(result.poses[0]), result.poses)), truth)
    error = result.poses - compose(compose(result.poses[0], inverse(truth[0])), truth)
    error[:, 2] = d[:, 2]
    chi2 = np.einsum(
        "ki,kij,kj->k",
        error,
        np.linalg.inv(result.covariances[: len(error)] + 1e-9 * np.eye(3)),
        error,
    )
    off, states = np.hypot(error[:, 0], error[:, 1]), result.health.states
    tracking = states == TRACKING
    at_end = off[min(begin + 3 * rows, len(off) - 1)]
    return Faulty(
        float((states[begin : begin + rows] != TRACKING).mean()),
        float(off[begin:].max()),
        float(at_end),
        float((chi2[tracking] < GATE_3D_99).mean()),
        int((tracking & (off > MAX_ERROR) & (chi2 > GATE_3D_999)).sum()),
    )


def clean(data: Path, name: str) -> str:
    """Return a row for a log without faults."""
    log = read(data, name)
    health = mapped(log.config, log.pairs).health
    hours = np.median(np.abs(np.diff(log.stamps))) * len(log.stamps) / 3600.0
    spans = [span.reason for span in health.spans()]
    begun = (
        np.diff(health.reasons == ELSEWHERE, prepend=False) & (health.reasons == ELSEWHERE)
    ).sum()
    suspected, scans = spans.count(UNEXPLAINED), len(log.stamps)
    degraded = 100.0 * (health.states == 1).mean()
    return row(name, f"{hours:.2f} h", scans, suspected, begun, f"{degraded:.1f} %")


def kidnappings(found: list[Kidnapping], name: str) -> str:
    """Return a row for kidnappings."""
    seconds, metres, off, before = (
        np.array([getattr(one, key) for one in found])
        for key in ("seconds", "metres", "off", "before")
    )
    again = np.isfinite(metres)
    off, before = 100.0 * off[again], 100.0 * before[again]
    return row(
        name,
        len(found),
        sum(one.suspected for one in found),
        (seconds <= 1.0).sum(),
        f"{np.median(seconds):.1f} / {seconds.max():.1f} s",
        again.sum(),
        f"{np.median(metres[again]):.1f} m" if again.any() else "",
        (off > 100.0 * MAX_ERROR).sum(),
        f"{np.median(off):.1f} / {np.median(before):.1f} cm" if again.any() else "",
        sum(one.entered for one in found),
    )


def faults(found: list[Faulty], fault: str, name: str) -> str:
    """Return a row for a fault."""
    said, worst, end, inside = (
        np.mean([getattr(one, key) for one in found]) for key in ("said", "worst", "end", "inside")
    )
    off = f"{worst:.2f}, {end:.2f} m"
    silent = sum(one.silent > 0 for one in found)
    return row(fault, name, len(found), f"{100 * said:.0f} %", off, f"{100 * inside:.1f} %", silent)


def row(*cells: object) -> str:
    """Return a row of a table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def head(*cells: str) -> str:
    """Return the head of a table."""
    return f"\n{row(*cells)}\n{'|---' * len(cells)}|"


def main() -> None:
    """Run all, and print the tables."""
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("--runs", type=int, default=30, help="kidnappings of each log")
    options.add_argument(
        "--buildings",
        type=int,
        default=100,
        help="kidnappings in random ones, and five times the runs of each fault there",
    )
    options.add_argument("--faults", type=int, default=3, help="runs of each fault on each log")
    options.add_argument("--first", type=int, default=0, help="the first seed")
    options.add_argument("--jobs", type=int, default=1)
    given = options.parse_args()
    data, first, logs = given.data, given.first, (*LOGS, SIMULATED)
    with get_context("spawn").Pool(given.jobs) as pool:
        print(head(*KIDNAPPED))
        for name in (*logs, BUILDING):
            runs = given.buildings if name == BUILDING else given.runs
            tasks = [(data, name, first + k) for k in range(runs)]
            if tasks:
                print(kidnappings(pool.map(kidnap, tasks, chunksize=5), name), flush=True)
        print(head(*FAILED))
        for fault in FAULTS:
            for name in (*logs, BUILDING):
                runs = given.buildings // 5 if name == BUILDING else given.faults
                ways = [(data, name, fault, first + k) for k in range(runs)]
                print(faults(pool.map(fail, ways, chunksize=5), fault, name), flush=True)
    print(head("clean log", "time", "scans", "suspected", "LOST", "DEGRADED"))
    for name in CLEAN:
        print(clean(data, name), flush=True)


if __name__ == "__main__":
    main()
