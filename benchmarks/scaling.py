"""Time per scan and memory of a map when a building is driven repeatedly.

    python -m benchmarks.scaling --data ../shared/data           # Intel driven 1, 2, 4 and 8 times

The log is replayed alternately forward and backward; backward, the scans are in reverse order and odometry
continues. So the robot stays in the same building. Each length runs in a process of its own; times are its
CPU times, including the loading of kernels but not the reading of the log.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

from benchmarks.perturbed import PLAIN

from impslam.columns import Batch, batches, messages
from impslam.geometry.se2 import between, compose
from impslam.open_log import open_log
from impslam.run import Run
from impslam.sweeps.memory import peak_memory
from impslam.types import Message, OdometryPose

BREAK = 0.2  # s between the last row of a drive and the first of the next


def driven(log: list[tuple[str, Message]], times: int) -> Iterator[tuple[str, Message]]:
    """Yield the rows of a log forward and backward, with continuous stamps and odometry."""
    start = stamp = log[0][1].stamp
    pose = None
    for drive in range(times):
        rows = log if drive % 2 == 0 else log[::-1]
        origin = rows[0][1].stamp
        last = next(m.pose for _, m in rows if isinstance(m, OdometryPose))
        pose = last if pose is None else pose
        for stream, message in rows:
            stamp = start + abs(message.stamp - origin)
            if isinstance(message, OdometryPose):
                pose, last = compose(pose, between(last, message.pose)), message.pose
                yield stream, replace(message, stamp=stamp, pose=pose)
            else:
                yield stream, replace(message, stamp=stamp)
        start = stamp + BREAK


def measure(task: tuple[Path, int]) -> list[float]:
    """Return numbers of scans, keyframes, stored scans, nodes and closures; CPU times and memory."""
    log, times = task
    config, source = open_log(log, None, PLAIN)
    with source:
        rows = [
            (stream, message) for batch in source.batches() for stream, message in _named(batch)
        ]
        streams = source.defaults()
    run = Run(config)
    run.robot.streams.choose(streams)
    parts = list(batches(driven(rows, times)))
    before = _peak()
    begin = time.process_time()
    marks = []
    for part in parts:
        run.feed(part)
        marks.append((time.process_time() - begin, run.scans))
    run.flush()
    spent, scans = marks[-1]
    late = next(k for k, mark in enumerate(marks) if mark[1] >= 0.9 * scans)
    newest = (spent - marks[late][0]) / (scans - marks[late][1])
    begin = time.process_time()
    known = run.refined()
    refining = time.process_time() - begin
    graph = run.estimator._graph  # type: ignore[attr-defined]  # the graph's
    kept = int((known.keyframes.starts[1:] > known.keyframes.starts[:-1]).sum())
    counts = [scans, len(known.keyframes), kept, int((~graph.is_folded).sum()), graph.closures]
    return [*counts, 1e3 * spent / scans, 1e3 * newest, refining, _peak() - before]


def _named(batch: Batch) -> Iterator[tuple[str, Message]]:
    for message in messages([batch]):
        kind = type(message)
        yield next(name for name, c in batch.items() if c.kind is kind), message


def _peak() -> float:
    return peak_memory() / 2**20


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("--log", default="intel")
    options.add_argument("--times", type=int, nargs="+", default=[1, 2, 4, 8])
    given = options.parse_args()
    head = "driven|scans|keyframes|kept|nodes|closures|scan, ms|of the last tenth|refining, s|memory, MB"
    print("| " + head.replace("|", " | ") + " |\n|" + "---|" * 10)
    log = given.data / given.log / f"{given.log}.log"
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for times in given.times:
            *counts, mean, last, refining, memory = pool.apply(measure, [(log, times)])
            numbers = " | ".join(str(count) for count in (times, *counts))
            print(
                f"| {numbers} | {mean:.3f} | {last:.3f} | {refining:.1f} | {memory:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
