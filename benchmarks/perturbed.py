"""Robustness of maps of buildings against worse odometry.

    python benchmarks/perturbed.py --data ../shared/data                     # 100 runs a log, factor 1
    python benchmarks/perturbed.py --data ../shared/data --runs 20 --factors 1 2 4 8 --plot FILE

Each run adds random errors to the odometry of a recorded log: a scale error, a heading bias per distance,
noise, and slips; see `perturb`. A run fails if one of the log's relations is off by more than 0.5 m. The
runs depend only on the seeds, not on the number of processes.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Iterator, Sequence
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.columns import Batch
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.geometry.se2 import between, compose
from impslam.open_log import open_log
from impslam.run import Run
from impslam.sources.base import Source
from impslam.types import Array, OdometryPose

LOGS = ("intel", "fr079")
MAX_ERROR = 0.5  # m, of a relation: a map with a larger error leads a robot into a wall
MAX_SCALE, MAX_BIAS = 0.05, 0.03  # 1 and rad/m, of each run
NOISE = np.array([0.05, 0.05, 0.05])  # m, m and rad per root metre
METRES_PER_RADIAN = 0.3  # distance that a turn counts for
SLIPS, MAX_SLIP = 10, 0.5  # per run; m or rad
PLAIN = [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "cylinders", "corners")]


class Outcome(NamedTuple):
    """Result of a run: relation errors in m and degrees, and loop closures."""

    log: str
    factor: float
    seed: int
    mean: float
    worst: float
    degrees: float
    closures: int

    @property
    def failed(self) -> bool:
        return self.worst > MAX_ERROR


def perturb(motions: Array, rng: np.random.Generator, factor: float) -> Array:
    """Return motions (m, 3) with errors of `factor` times the constants of this module."""
    scale, turn_scale = 1.0 + factor * rng.uniform(-MAX_SCALE, MAX_SCALE, 2)
    distance = np.hypot(motions[:, 0], motions[:, 1])
    length = (distance + METRES_PER_RADIAN * np.abs(motions[:, 2]))[:, None]
    worse = motions * [scale, scale, turn_scale]
    worse[:, 2] += factor * rng.uniform(-MAX_BIAS, MAX_BIAS) * distance
    worse += factor * NOISE * np.sqrt(length) * rng.standard_normal(motions.shape)
    moving = np.flatnonzero(length[:, 0] > 0.0)
    for at in rng.choice(moving, SLIPS, replace=False):
        size, direction = factor * rng.uniform(-MAX_SLIP, MAX_SLIP), rng.uniform(0.0, np.pi)
        if rng.random() < 0.5:
            worse[at, 2] += size
        else:
            worse[at, :2] += size * np.array([np.cos(direction), np.sin(direction)])
    return worse


def perturbed(batches: Sequence[Batch], seed: int, factor: float) -> Iterator[Batch]:
    """Yield a log with its odometry perturbed, in the order of the log over all its streams."""
    odometry = [c for batch in batches for c in batch.values() if c.kind is OdometryPose]
    rank = np.argsort(np.concatenate([c.order for c in odometry]), kind="stable")
    poses = np.concatenate([c["pose"] for c in odometry])
    motions = perturb(
        between(poses[rank][:-1], poses[rank][1:]), np.random.default_rng([seed, 7]), factor
    )
    pose = poses[rank[0]]
    new = np.empty_like(poses)
    new[rank[0]] = pose
    for k, d_pose in zip(rank[1:], motions, strict=True):
        pose = compose(pose, d_pose)
        new[k] = pose
    first = 0
    for batch in batches:
        changed = dict(batch)
        for name, columns in batch.items():
            if columns.kind is OdometryPose:
                rows = new[first : first + len(columns)]
                changed[name] = replace(columns, values={**columns.values, "pose": rows})
                first += len(columns)
        yield changed


def map_perturbed(log: Path, seed: int, factor: float) -> tuple[Run, Source, list[Batch]]:
    """Return an unfinished run on a log with perturbed odometry, and its remaining input."""
    config, source = open_log(log, None, PLAIN)
    run = Run(config)
    with source:
        read = list(run.robot.streams.read(source))
    for batch in perturbed(read, seed, factor) if factor else read:
        run.feed(batch)
    run.flush()
    return run, source, read


def outcome(task: tuple[Path, str, float, int]) -> Outcome:
    """Run once."""
    data, name, factor, seed = task
    run, source, _ = map_perturbed(data / name / f"{name}.log", seed, factor)
    path = run.finish(source).path()
    errors = relation_errors(path, read_relations(data / name / f"{name}.relations"))
    closures = run.estimator._graph.closures  # type: ignore[attr-defined]  # the graph's
    del run
    gc.collect()
    degrees = float(np.degrees(errors.rotation.mean()))
    metres = errors.translation
    return Outcome(name, factor, seed, metres.mean(), metres.max(), degrees, closures)


def table(found: Sequence[Outcome]) -> str:
    """Return failures and errors by log and factor, as a table."""
    lines = [
        "| log | factor | runs | failed | mean error: median, 90 %, worst | "
        "worst relation: median, worst |",
        "|---|---|---|---|---|---|",
    ]
    for name, factor in dict.fromkeys((o.log, o.factor) for o in found):
        some = [o for o in found if (o.log, o.factor) == (name, factor)]
        mean, worst = np.array([o.mean for o in some]), np.array([o.worst for o in some])
        lines.append(
            f"| {name} | {factor:g} | {len(some)} | {sum(o.failed for o in some)} | "
            f"{np.median(mean):.4f}, {np.quantile(mean, 0.9):.4f}, {mean.max():.4f} m | "
            f"{np.median(worst):.2f}, {worst.max():.2f} m |"
        )
    return "\n".join(lines)


def plot(found: Sequence[Outcome], path: Path) -> None:
    """Draw the share of runs that fail, and the mean errors, against the factor."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only here

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    share, error = figure.subplots(1, 2)
    for color, name in enumerate(dict.fromkeys(o.log for o in found)):
        mine = [o for o in found if o.log == name]
        factors = sorted({o.factor for o in mine})
        failed = [100.0 * np.mean([o.failed for o in mine if o.factor == f]) for f in factors]
        share.plot(factors, failed, "o-", color=f"C{color}", label=name)
        x = np.array([o.factor for o in mine]) * 1.04 ** (2 * color - 1)
        error.plot(x, [o.mean for o in mine], ".", color=f"C{color}", alpha=0.5, label=name)
    share.set(
        xscale="log", ylabel=f"runs with a relation off by > {MAX_ERROR} m, %", ylim=(-3, 103)
    )
    error.set(
        xscale="log",
        ylim=(0.0, 1.1 * max(o.mean for o in found)),
        ylabel="mean relation error of a run, m",
    )
    for axes in (share, error):
        axes.set_xlabel("factor on the errors added to odometry")
        ticks = sorted({o.factor for o in found})
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("--logs", nargs="+", default=LOGS)
    options.add_argument("--runs", type=int, default=100)
    options.add_argument("--first", type=int, default=0, help="the first seed")
    options.add_argument("--factors", nargs="+", type=float, default=[1.0])
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--plot", type=Path)
    given = options.parse_args()
    seeds = range(given.first, given.first + given.runs)
    tasks = [(given.data, n, f, s) for n in given.logs for f in given.factors for s in seeds]
    found = []
    with get_context("spawn").Pool(given.jobs) as pool:
        for o in pool.imap(outcome, tasks):
            found.append(o)
            if o.failed:
                print(f"{o.log} factor {o.factor:g} seed {o.seed}: {o}", flush=True)
    print(table(found))
    if given.plot:
        plot(found, given.plot)


if __name__ == "__main__":
    main()
