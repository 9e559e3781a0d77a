"""Maps of recorded buildings with other lidars: fewer beams, a narrower view, a shorter range, more noise.

    python -m benchmarks.lidars --data ../shared/data                  # 1.5 min on two cores
    python -m benchmarks.lidars --data ../shared/data --plot FILE
    python -m benchmarks.lidars --data ../shared/data --shifts 10      # ten maps of each lidar

Each lidar is emulated from the scans of the log, which has 180 beams at 1 degree and ranges of 30 m or
more. Then the whole log is mapped with the default config, and with the odometry withheld. One map is one
draw where few places are recognised; with several shifts, each begins at other scans and beams.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.config import load
from impslam.config_from_log import fitted
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.run import map_log
from impslam.studies.drives import DriveSource, RecordedDrive, recorded
from impslam.types import Array

LOGS = ("intel", "fr079")
SKIPPED = 3  # scans at the beginning, for each shift: other scans become keyframes
BROKEN = 0.5  # m, mean relation error


class Lidar(NamedTuple):
    """An emulated lidar.

    Attributes
    ----------
    every : one of so many beams is kept
    view : angle of view, rad
    reach : maximum range, m; farther beams have no return
    noise : standard deviation added to each range, m
    step : ranges are rounded to multiples of it, m
    lost : share of the beams without a return, at random
    scale : factor on the ranges
    """

    every: int = 1
    view: float = np.pi
    reach: float = np.inf
    noise: float = 0.0
    step: float = 0.0
    lost: float = 0.0
    scale: float = 1.0

    def ranges(self, ranges: Array, rng: np.random.Generator) -> Array:
        """Return the ranges (n, beams) in m that this lidar measures, NaN without a return."""
        seen = self.scale * ranges
        if self.noise:
            seen = seen + self.noise * rng.standard_normal(seen.shape)
        if self.step:
            seen = self.step * np.round(seen / self.step)
        if self.lost:
            seen = np.where(rng.random(seen.shape) < self.lost, np.nan, seen)
        return np.where(seen > self.reach, np.nan, seen)


LIDARS = {
    "as recorded": Lidar(),
    "a beam every 2°": Lidar(every=2),
    "a beam every 3°": Lidar(every=3),
    "a beam every 4°": Lidar(every=4),
    "a beam every 6°": Lidar(every=6),
    "a beam every 8°": Lidar(every=8),
    "view of 120°": Lidar(view=np.radians(120.0)),
    "view of 90°": Lidar(view=np.radians(90.0)),
    "12 m of range": Lidar(reach=12.0),
    "8 m of range": Lidar(reach=8.0),
    "5.6 m of range": Lidar(reach=5.6),
    "4 m of range": Lidar(reach=4.0),
    "3 cm of noise": Lidar(noise=0.03),
    "6 cm of noise": Lidar(noise=0.06),
    "rounded to 5 cm": Lidar(step=0.05),
    "30 % of beams lost": Lidar(lost=0.3),
    "ranges 2 % too long": Lidar(scale=1.02),
}


class Outcome(NamedTuple):
    """Result of a run: relation errors in m, and loop closures."""

    log: str
    lidar: str
    alone: bool
    mean: float
    worst: float
    closures: int


@cache
def _drive(log: Path) -> RecordedDrive:
    return recorded(log, None, np.inf)


def emulated(drive: RecordedDrive, lidar: Lidar, shift: int = 0) -> RecordedDrive:
    """Return a drive as recorded with another lidar, from a later scan on and with other beams by shift."""
    angles, scans = drive.scans["angles"], drive.scans
    beams = np.flatnonzero(np.abs(angles) <= lidar.view / 2.0 + 1e-9)
    beams = beams[shift % lidar.every :: lidar.every]
    ranges = lidar.ranges(scans["ranges"], np.random.default_rng(0))[:, beams]
    per_beam = {
        name: value[beams]
        for name, value in scans.layout.items()
        if np.shape(value) == np.shape(angles)
    }
    scans = replace(
        scans,
        values={**scans.values, "ranges": ranges},
        layout={**scans.layout, **per_beam},
    )
    return drive._replace(scans=scans).keep(slice(SKIPPED * shift, None), slice(None))


def outcome(task: tuple[Path, str, str, bool, int]) -> Outcome:
    """Map a log with an emulated lidar, with its odometry or without."""
    data, name, lidar, alone, shift = task
    drive = emulated(_drive(data / name / f"{name}.log"), LIDARS[lidar], shift)
    if alone:
        config = load("default", ["odometry.kind=lidar_only"])
        source = DriveSource.of(drive.keep(slice(None), slice(0, 0)))
    else:
        source = DriveSource.of(drive)
        config = fitted(drive.config, source, odometry_is_free=True)
    found = map_log(config, source, [])
    errors = relation_errors(found.path(), read_relations(data / name / f"{name}.relations"))
    closures = int(np.isfinite(found.edges.kernel).sum())
    metres = errors.translation
    return Outcome(name, lidar, alone, float(metres.mean()), float(metres.max()), closures)


def table(found: Sequence[Outcome]) -> str:
    """Return errors and closures by lidar, a column for each log with and without odometry.

    Of several shifts, those are medians, followed by the range of the mean error.
    """
    columns = list(dict.fromkeys((o.log, o.alone) for o in found))
    heads = [_heading(log, alone=alone) for log, alone in columns]
    lines = [
        "mean (worst) relation error in m, loop closures",
        "| lidar | " + " | ".join(heads) + " |",
        "|---" * (1 + len(heads)) + "|",
    ]
    for lidar in dict.fromkeys(o.lidar for o in found):
        draws = ([o for o in found if (o.lidar, o.log, o.alone) == (lidar, *c)] for c in columns)
        lines.append(f"| {lidar} | " + " | ".join(map(_cell, draws)) + " |")
    return "\n".join(lines)


def _cell(draws: Sequence[Outcome]) -> str:
    mean, worst, closures = np.transpose([(o.mean, o.worst, o.closures) for o in draws])
    cell = f"{np.median(mean):.3f} ({np.median(worst):.2f}), {np.median(closures):.0f}"
    return cell if len(draws) == 1 else f"{cell}; {mean.min():.3f} to {mean.max():.3f}"


def _heading(log: str, *, alone: bool) -> str:
    return f"{log}, lidar alone" if alone else log


def plot(found: Sequence[Outcome], path: Path) -> None:
    """Draw the mean relation errors."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only here

    lidars = list(dict.fromkeys(o.lidar for o in found))
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    axes = figure.subplots()
    columns = list(dict.fromkeys((o.log, o.alone) for o in found))
    for k, (log, alone) in enumerate(columns):
        some = [o for o in found if (o.log, o.alone) == (log, alone)]
        axes.plot(
            [o.mean for o in some],
            [lidars.index(o.lidar) + 0.12 * (k - 1.5) for o in some],
            "x" if alone else "o",
            color=f"C{LOGS.index(log)}",
            label=_heading(log, alone=alone),
        )
    axes.axvspan(BROKEN, 20.0, color="0.9", label="broken map")
    axes.set(xscale="log", xlim=(0.01, 20.0), xlabel="mean relation error, m")
    axes.set_yticks(range(len(lidars)), lidars)
    axes.invert_yaxis()
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--data", type=Path, required=True)
    options.add_argument("--logs", nargs="+", default=LOGS, choices=LOGS)
    options.add_argument("--lidars", nargs="+", default=list(LIDARS), choices=list(LIDARS))
    options.add_argument("--shifts", type=int, default=1, help="maps of each lidar")
    options.add_argument("--jobs", type=int, default=2)
    options.add_argument("--plot", type=Path)
    given = options.parse_args()
    tasks = [
        (given.data, log, lidar, alone, shift)
        for log in given.logs
        for alone in (False, True)
        for lidar in given.lidars
        for shift in range(given.shifts)
    ]
    found = []
    with get_context("spawn").Pool(given.jobs) as pool:
        for o in pool.imap(outcome, tasks):
            found.append(o)
            print(f"{_heading(o.log, alone=o.alone)}, {o.lidar}: {o.mean:.3f} m", flush=True)
    print(table(found))
    if given.plot:
        plot(found, given.plot)


if __name__ == "__main__":
    main()
