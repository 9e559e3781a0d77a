"""Continuing a map: logs stopped at random and resumed, and halves localised in halves.

    python benchmarks/resumed.py DATA [fr079 intel ...]

DATA contains a folder for each log, with NAME.log (CARMEN) and NAME.relations. A log is stopped at ten
random scans, its map is saved, loaded and continued with the whole log. Then the map of the first half is
frozen, and the second half is localised in it. Relation errors are those of the SLAM benchmarking suite.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from impslam.continuing import KnownMap
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.map import Map
from impslam.open_log import open_log
from impslam.run import Run, map_log, run
from impslam.types import Array

STOPS = 10
MAX_INCREASE = 0.05  # of the relation error by resuming


def stopped(log: Path, scans: int) -> Map:
    """Return the map of a run that is stopped after a number of scans."""
    config, source = open_log(log)
    course = Run(config)
    with source:
        for batch in course.robot.streams.read(source, 64):
            course.feed(batch)
            if course.scans >= scans:
                break
    return course.refined()


def error(known: Map, relations: Array) -> float:
    """Return the mean relation error of a map's path, m."""
    return relation_errors(known.path(), relations).metres.mean


def resume(log: Path, relations: Array, folder: Path) -> None:
    """Stop a log at random scans, continue it, and print the errors."""
    whole = run(log)
    expected, n = error(whole, relations), len(whole.stamps)
    file = whole.save(folder / "whole.imp")
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        Map.load(file)
        times.append(time.perf_counter() - begin)
    size = file.stat().st_size / 1e6
    print(f"{log.name}: {expected:.4f} m; map.imp {size:.1f} MB, loaded in {min(times):.3f} s")
    print("| stopped at | error m | change | worst shift m |\n|---|---|---|---|")
    rng, worst = np.random.default_rng(0), 0.0
    for scans in np.sort(rng.integers(1, n, STOPS)).tolist():
        part = Map.load(stopped(log, scans).save(folder / "part.imp"))
        again = run(log, known=part)
        change = error(again, relations) / expected - 1.0
        apart = again.path()[:, 1:3] - whole.path()[:, 1:3]
        print(f"| {len(part.stamps)} of {n} | {error(again, relations):.4f} | {100.0 * change:+.1f} % "
              f"| {np.hypot(*apart.T).max():.3f} |", flush=True)  # fmt: skip
        worst = max(worst, abs(change))
    print(f"worst change {100.0 * worst:.1f} % (limit {100.0 * MAX_INCREASE:.0f} %)")


def localise(log: Path, folder: Path) -> None:
    """Freeze the map of a log's first half, localise the second, and compare with the whole run."""
    lines = log.read_text(encoding="latin-1").splitlines(keepends=True)
    scans = [k for k, line in enumerate(lines) if line.startswith(("FLASER", "ROBOTLASER1"))]
    cut = scans[len(scans) // 2]
    halves = folder / "first.log", folder / "second.log"
    for half, part in zip(halves, (lines[:cut], lines[cut:]), strict=True):
        half.write_text("".join(part), encoding="latin-1")
    whole, first = run(log).path(), run(halves[0])
    begin = time.process_time()
    config, source = open_log(halves[1])
    there = map_log(config, source, begin=KnownMap(first, frozen=True)).path()
    seconds = time.process_time() - begin
    off = np.hypot(*(there - whole[len(whole) - len(there) :])[:, 1:3].T)
    q = np.percentile(off, [50, 95])
    print(f"{log.name}: second half in the frozen map of the first: {len(there)} scans, from the whole "
          f"run's path {off.mean():.3f} m in the mean, {q[0]:.3f} median, {q[1]:.3f} at 95 %, "
          f"{off.max():.3f} worst; {seconds:.1f} s CPU")  # fmt: skip


def main(data: Path, names: list[str]) -> None:
    """Print the tables for each log."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names or ["fr079", "intel"]:
            log = data / name / f"{name}.log"
            resume(log, read_relations(log.with_suffix(".relations")), Path(folder))
            localise(log, Path(folder))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
