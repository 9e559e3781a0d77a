"""Maps of recorded buildings: accuracy, time, and loop closures.

    python -m benchmarks.buildings --data ../shared/data            # tables, in Markdown
    python -m benchmarks.buildings --data ../shared/data intel      # only this log

Errors are those of manually verified relations (Kümmerle et al. 2009); local ones span at most 60 s. A
loop closure is false if the refined poses differ from it by more than 0.5 m or 5 degrees. Times are CPU
times of one core: for a scan, in batches of one row and with all processing; for the command, in a process
of its own, with all files written and compiled code loaded from the cache.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from impslam.evaluation.relations import read_relations, relation_errors
from impslam.geometry.se2 import between
from impslam.map import Map
from impslam.open_log import open_log
from impslam.run import Run
from impslam.types import Array, LaserScan

LOGS = ("intel", "fr079", "fr-hospital")
LOCAL = 60.0  # s between the two poses of a local relation
FALSE = 0.5, np.radians(5.0)  # m, rad
COMMAND = [sys.executable, "-c", "import sys; from impslam.cli import main; sys.exit(main())"]

CHILD = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""


class Closures(NamedTuple):
    """Results of the search for loops: counts by name, and CPU times (n,) in ms of each attempt."""

    counts: dict[str, int]
    milliseconds: Array


class Mapped(NamedTuple):
    """A log mapped by batches of one row."""

    known: Map
    closures: Closures
    steps: Array  # (n,) CPU ms of each batch with a scan


def timed(function: Callable[..., Any], into: list[float]) -> Callable[..., Any]:
    """Return a function that appends its CPU times to a list, in ms."""

    def call(*args: Any) -> Any:
        begin = time.process_time()
        result = function(*args)
        into.append(1e3 * (time.process_time() - begin))
        return result

    return call


def map_by_rows(log: Path, *settings: str) -> Mapped:
    """Map a log, one row at a time."""
    config, source = open_log(log, None, settings)
    run, steps, attempts = Run(config), [], []
    closer = run.estimator._closer  # type: ignore[attr-defined]  # the graph's
    closer.recogniser.find_closure = timed(closer.recogniser.find_closure, attempts)
    with source:
        for batch in run.robot.streams.read(source, 1):
            begin = time.process_time()
            run.feed(batch)
            if any(columns.kind is LaserScan for columns in batch.values()):
                steps.append(1e3 * (time.process_time() - begin))
    run.flush()
    known = run.finish(source)
    return Mapped(known, Closures(count(run, known), np.array(attempts)), np.array(steps))


def count(run: Run, known: Map) -> dict[str, int]:
    """Return what came of the attempts; those that wait for another in vain are unconfirmed.

    A closure whose node was folded is checked as the edge that it has become.
    """
    graph, keys = run.estimator._graph, run.estimator._keys  # type: ignore[attr-defined]
    edges = graph.edges
    closing = np.isfinite(edges.kernel)
    poses = known.keyframes.poses[keys.nodes]
    off = between(between(poses[edges.i], poses[edges.j]), edges.T_i_j)[closing]
    false = (np.hypot(off[:, 0], off[:, 1]) > FALSE[0]) | (np.abs(off[:, 2]) > FALSE[1])
    counts = dict(run.estimator._closer.recogniser.counts)  # type: ignore[attr-defined]
    found, accepted = counts.pop("found"), graph.closures
    return {
        "tried": counts.pop("attempts"),
        "accepted": accepted,
        **counts,
        "unconfirmed": found - accepted,
        "false": int(false.sum()),
    }


def errors(data: Path, name: str, path: Array) -> list[str]:
    """Return errors of a path (n, 4): mean, median, worst m; mean degrees; local mean m."""
    relations = read_relations(data / name / f"{name}.relations")
    of = relation_errors(path, relations)
    local = relations[np.abs(relations[:, 1] - relations[:, 0]) <= LOCAL]
    m = of.translation
    return [
        f"{m.mean():.4f}",
        f"{np.median(m):.4f}",
        f"{m.max():.2f}",
        f"{np.degrees(of.rotation.mean()):.3f}",
        f"{relation_errors(path, local).translation.mean():.4f}",
    ]


def command(log: Path) -> tuple[float, float]:
    """Return CPU s and peak memory in MB of the whole command, the minimum of two runs."""
    found = []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            run = [*COMMAND, "run", str(log), "-o", str(Path(folder) / "run"), "--quiet"]
            said = subprocess.run(
                [sys.executable, "-c", CHILD, *run], capture_output=True, text=True, check=True
            ).stdout
        found.append(tuple(map(float, said.split()[-2:])))
    return min(found)


def row(*cells: object) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def table(head: tuple[str, ...], rows: list[str]) -> None:
    print("\n".join([row(*head), "|" + "---|" * len(head), *rows]), end="\n\n", flush=True)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("logs", nargs="*", default=LOGS)
    given = options.parse_args()
    right, loops, fast = [], [], []
    for name in given.logs:
        log = given.data / name / f"{name}.log"
        whole = command(log)
        mapped = map_by_rows(log)
        alone = map_by_rows(log, "odometry.kind=lidar_only")
        right.append(row(name, *errors(given.data, name, mapped.known.path())))
        right.append(row(f"{name}, lidar alone", *errors(given.data, name, alone.known.path())))
        counts, ms = mapped.closures
        loops.append(row(name, *counts.values(), f"{np.median(ms):.1f}", f"{ms.max():.0f}"))
        quantiles = [f"{q:.2f}" for q in np.quantile(mapped.steps, [0.5, 0.99, 0.999, 1.0])]
        fast.append(row(name, *quantiles, f"{whole[0]:.1f}", f"{whole[1]:.0f}"))
    table(("relation errors", "mean, m", "median", "worst", "rotation, °", "local mean, m"), right)
    table(("loop closures", *counts, "median, ms", "worst, ms"), loops)
    table(("CPU", "scan p50, ms", "p99", "p99.9", "worst", "command, s", "peak, MB"), fast)


if __name__ == "__main__":
    main()
