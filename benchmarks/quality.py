"""Correlation of map quality without truth and errors against the truth.

    python -m benchmarks.quality --data ../shared/data                      # tables, in Markdown
    python -m benchmarks.quality --data ../shared/data intel --plot FILE    # this log alone, and a picture

Each log is mapped many times: with different components, and with odometry perturbed as in `perturbed.py`
(for simulated logs, with another robot). The default map is also degraded: keyframes are shaken, moved by
a random walk, bent, stretched, warped. The error of each map is the mean relation error of recorded
buildings (Kümmerle et al. 2009), or the aligned RMS position error of simulated drives. The tables contain
Spearman's rank correlation of that error with the quality and its parts, and with published measures of
the point cloud and the grid; and the share of correctly ranked pairs among maps with errors that differ by
at least a fifth.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.perturbed import PLAIN, perturbed
from benchmarks.simulated_building import BUILDING
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from impslam.cli.simulate import load_robot, truth_path, write_log
from impslam.evaluation.quality import quality
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.evaluation.trajectory import associate, ate
from impslam.evaluation.tum import read_tum
from impslam.geometry.se2 import between, compose, transform
from impslam.map import Map
from impslam.maps.files import FREE, OCCUPIED, map_image
from impslam.open_log import open_log
from impslam.run import Run
from impslam.simulation.world import World, load_world
from impslam.types import Array

RECORDED = ("intel", "fr079", "fr-hospital")
WORLDS = {"arena": None, "building": BUILDING}
GRAPH = ("tracker.kind=scan_to_map", "estimator.kind=graph")
NO_LOOPS, DEAD = "estimator.loops.candidates=0", "tracker.kind=odometry"
RADIUS, SAMPLE = 0.3, 1500  # m around a point, and points, for the measures of the point cloud
OURS = ("disagreement_m", "within_m", "between_m", "thickness_m", "contradicted", "doubled")
OTHERS = ("mean map entropy", "mean plane variance", "occupied cells")


@dataclass(frozen=True)
class Variant:
    """A way to map a log; `bad` is the factor on the errors added to odometry, by a seed."""

    name: str
    settings: tuple[str, ...] = ()
    bad: float = 0.0
    seed: int = 0
    refined: bool = True


def variants() -> Iterator[Variant]:
    """Yield the variants with which each log is mapped, the default first."""
    yield Variant("default")
    yield Variant("one round", ("estimator.rounds=1",))
    yield Variant("not refined", refined=False)
    for bad in (1.0, 4.0, 8.0, 16.0):
        yield from (Variant(f"odometry x {bad:g}", (), bad, seed) for seed in (1, 2))
    for bad in (0.0, 4.0, 8.0):
        yield Variant(f"no loops, odometry x {bad:g}", (NO_LOOPS,), bad, 3)
        yield Variant(f"no loops, not refined, x {bad:g}", (NO_LOOPS,), bad, 4, refined=False)
    yield Variant("dead reckoning", (DEAD, NO_LOOPS), refined=False)
    yield Variant("dead reckoning x 1", (DEAD, NO_LOOPS), 1.0, 5, refined=False)
    yield Variant("dead reckoning, refined", (DEAD, NO_LOOPS))
    yield Variant("dead reckoning, loops", (DEAD,))
    yield Variant("landmarks", ("estimator.kind=landmarks",))
    yield Variant("landmarks, odometry x 1", ("estimator.kind=landmarks",), 1.0, 6)
    yield Variant("landmarks, dead reckoning", ("estimator.kind=landmarks", DEAD))
    yield Variant("lidar alone", ("odometry.kind=lidar_only",))
    yield Variant("lidar alone, no loops", ("odometry.kind=lidar_only", NO_LOOPS))


def map_log(log: Path, way: Variant) -> Map:
    """Return the map of a log, made in one way."""
    plain = () if any("landmarks" in s for s in way.settings) else tuple(PLAIN)
    simulated = log.suffix == ".mcap"
    config, source = open_log(log, None, [*(GRAPH if simulated else ()), *plain, *way.settings])
    run = Run(config)
    with source:
        batches = list(run.robot.streams.read(source))
    worse = way.bad > 0.0 and not simulated
    for batch in perturbed(batches, way.seed, way.bad) if worse else batches:
        run.feed(batch)
    run.flush()
    return run.refined() if way.refined else run.map()


def degraded(known: Map) -> Iterator[tuple[str, Map]]:
    """Yield a map with its keyframes shaken, moved by a random walk, bent, stretched and warped."""
    rng, poses = np.random.default_rng(1), known.keyframes.poses
    steps = between(poses[:-1], poses[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])[:, None]
    for size in (0.005, 0.01, 0.02, 0.04, 0.08, 0.16):
        noise = rng.normal(size=poses.shape) * [size, size, size / 4]
        yield f"shaken {size:g}", placed(known, poses + noise)
    for size in (0.0005, 0.001, 0.002, 0.004, 0.008, 0.016):
        noise = rng.normal(size=steps.shape) * [size, size, size / 2] * np.sqrt(way)
        yield f"walk {size:g}", placed(known, chained(poses[0], steps + noise))
        bend = np.column_stack([0.0 * way, 0.0 * way, size / 4 * way])
        yield f"bent {size:g}", placed(known, chained(poses[0], steps + bend))
    window = np.hanning(min(60, len(poses)))
    for size in (0.003, 0.01, 0.03, 0.1):
        yield f"stretched {size:g}", placed(known, poses * [1.0 + size, 1.0 + size, 1.0])
        walk = np.cumsum(rng.normal(size=poses.shape), axis=0)
        smooth = np.stack([np.convolve(w, window, "same") for w in walk.T], axis=1)
        smooth *= np.array([size, size, size / 5]) / smooth.std(axis=0)
        yield f"warped {size:g}", placed(known, poses + smooth)


def placed(known: Map, poses: Array) -> Map:
    return replace(known, keyframes=replace(known.keyframes, poses=np.ascontiguousarray(poses)))


def chained(start: Array, steps: Array) -> Array:
    poses = [start]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def error(known: Map, truth: Path) -> float:
    """Return the mean relation error, or the RMS position error after alignment, in m."""
    if truth.suffix == ".relations":
        return float(relation_errors(known.path(), read_relations(truth)).translation.mean())
    return ate(associate(known.path(), read_tum(truth))).rmse


def other_measures(known: Map) -> dict[str, float]:
    """Return mean map entropy and mean plane variance (Razlaw et al. 2015), and the share of cells
    that are occupied (Filatov et al. 2017)."""
    frames, rng = known.keyframes, np.random.default_rng(0)
    scans = np.split(frames.points.astype(float), frames.starts[1:-1])
    placed_ = zip(frames.poses, scans, strict=True)
    points = np.concatenate([transform(pose, scan) for pose, scan in placed_])
    points = points[:: max(1, len(points) // 100_000)]
    chosen = points[rng.choice(len(points), min(SAMPLE, len(points)), replace=False)]
    entropies, variances = [], []
    for near in cKDTree(points).query_ball_point(chosen, RADIUS):
        if len(near) < 5:
            continue
        least, most = np.linalg.eigvalsh(np.cov(points[near].T) + 1e-9 * np.eye(2))
        entropies.append(0.5 * np.log((2.0 * np.pi * np.e) ** 2 * least * most))
        variances.append(least)
    pixels = map_image(known.grid()).pixels
    occupied, free = (pixels == OCCUPIED).sum(), (pixels == FREE).sum()
    shares = (np.mean(entropies), np.mean(variances), occupied / (occupied + free))
    return dict(zip(OTHERS, map(float, shares), strict=True))


def judged(name: str, way: str, known: Map, truth: Path) -> dict[str, Any]:
    """Return a row of the table: error, quality and other measures of a map."""
    begin = time.process_time()
    found = quality(known).figures()
    seconds = time.process_time() - begin
    row = {"log": name, "way": way, "error": error(known, truth), "seconds": seconds}
    return {**row, **found, **other_measures(known)}


def rows_of(task: tuple[str, Path, Path, Variant]) -> list[dict[str, Any]]:
    """Map a log in one way; of the default map, degrade it as well."""
    name, log, truth, way = task
    known = map_log(log, way)
    rows = [judged(name, way.name, known, truth)]
    if way.name == "default":
        rows += [judged(name, f"~{how}", worse, truth) for how, worse in degraded(known)]
    return rows


def simulated(name: str, world: World, way: Variant, folder: Path) -> Path:
    """Return the log of a drive through a world, by a robot with the variant's wheel errors."""
    log, bad = folder / f"{name}-{way.bad:g}-{way.seed % 2}.mcap", max(way.bad, 1.0)
    if not log.exists():
        settings = [f"encoders.slip_sigma={0.06 * bad}", f"encoders.noise={1e-4 * bad * bad}"]
        write_log(world, log, way.seed % 2, robot=load_robot(None, settings))
    return log


def tasks(data: Path, names: list[str], folder: Path) -> Iterator[tuple[str, Path, Path, Variant]]:
    for name in names:
        for way in variants():
            if name in WORLDS:
                log = simulated(name, WORLDS[name] or load_world(name), way, folder)
                yield name, log, truth_path(log), way
            else:
                place = data / name / name
                yield name, place.with_suffix(".log"), place.with_suffix(".relations"), way


def compared(rows: list[dict[str, Any]], measure: str) -> Array:
    """Return the errors and a measure (n, 2) of the maps that have both."""
    pairs = np.array([[row["error"], row[measure]] for row in rows], float)
    return pairs[np.isfinite(pairs).all(axis=1)]


def correlation(rows: list[dict[str, Any]], measure: str) -> float:
    """Return Spearman's rank correlation of a measure with the error."""
    return float(spearmanr(*compared(rows, measure).T).statistic)


def in_order(rows: list[dict[str, Any]], measure: str) -> float:
    """Return the share of pairs ranked correctly by a measure, for errors that differ by a fifth."""
    errors, values = compared(rows, measure).T
    i, j = np.triu_indices(len(errors), 1)
    differ = np.maximum(errors[i], errors[j]) > 1.2 * np.minimum(errors[i], errors[j])
    return float(((errors[i] < errors[j]) == (values[i] < values[j]))[differ].mean())


def tables(rows: list[dict[str, Any]]) -> None:
    """Print the correlations of all maps, and of maps that were not degraded artificially."""
    names = list(dict.fromkeys(row["log"] for row in rows))
    groups = {name: [row for row in rows if row["log"] == name] for name in names}
    runs = {
        name: [r for r in rows if not r["way"].startswith("~")] for name, rows in groups.items()
    }
    heads = [m.removesuffix("_m").replace("_", " ") for m in (*OURS, *OTHERS)]
    for what, how in (("rank correlation", correlation), ("pairs in order", in_order)):
        print(f"| {what} | maps | error, m | " + " | ".join(heads) + " |")
        print("|" + "---|" * (3 + len(heads)))
        for chosen, note in ((groups, ""), (runs, ", runs alone")):
            for name, some in chosen.items():
                errors = [row["error"] for row in some]
                cells = [f"{min(errors):.3f} to {max(errors):.2g}"]
                cells += [f"{how(some, measure):.2f}" for measure in (*OURS, *OTHERS)]
                print(f"| {name}{note} | {len(some)} | " + " | ".join(cells) + " |")
        print()
    seconds = {name: max(row["seconds"] for row in groups[name]) for name in names}
    print("CPU s of the quality, at most:", {name: round(s, 2) for name, s in seconds.items()})


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw disagreement against error, a panel for each log."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only here
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter  # noqa: PLC0415

    names = list(dict.fromkeys(row["log"] for row in rows))
    wide, high = min(3, len(names)), -(-len(names) // 3)
    figure = Figure(figsize=(3.4 * wide, 3.2 * high), layout="constrained")
    panels = figure.subplots(high, wide, squeeze=False).ravel()
    for axes, name in zip(panels, names, strict=False):
        mine = [row for row in rows if row["log"] == name]
        for by_hand, mark, label in ((True, "+", "default map, degraded"), (False, "o", "run")):
            some = [row for row in mine if row["way"].startswith("~") == by_hand]
            x, y = [row["error"] for row in some], [100 * row["disagreement_m"] for row in some]
            axes.loglog(x, y, mark, ms=5, alpha=0.6, label=label)
        first = next(row for row in mine if row["way"] == "default")
        axes.loglog(first["error"], 100 * first["disagreement_m"], "k*", ms=10, label="default")
        axes.set_title(f"{name}: ρ = {correlation(mine, 'disagreement_m'):.2f}")
        kind = "RMS position" if name in WORLDS else "mean relation"
        axes.set(xlabel=f"{kind} error, m", ylabel="disagreement of scans, cm")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    for axes in panels[len(names) :]:
        axes.axis("off")
    panels[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("logs", nargs="*", default=[*RECORDED, *WORLDS])
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--json", type=Path, help="all rows; read instead of made if it exists")
    options.add_argument("--plot", type=Path)
    given = options.parse_args()
    if given.json and given.json.exists():
        rows = json.loads(given.json.read_text())
    else:
        rows = []
        with tempfile.TemporaryDirectory() as folder, get_context("spawn").Pool(given.jobs) as pool:
            for some in pool.imap(rows_of, tasks(given.data, given.logs, Path(folder))):
                rows += some
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))
    tables(rows)
    if given.plot:
        plot(rows, given.plot)


if __name__ == "__main__":
    main()
