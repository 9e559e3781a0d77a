"""Reproduce all results quoted in the README and docs/results.md, and write the values into them.

    python benchmarks/results.py --data ../shared/data              # all, about ten minutes
    python benchmarks/results.py --data ../shared/data lego exp1    # only these
    python benchmarks/results.py --list

The values between `<!-- NAME -->` and `<!-- / -->` in the two files are replaced; pictures go to
docs/images.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image  # a dependency of matplotlib

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import outdoor, real_logs  # noqa: E402  found from the root of the project
from benchmarks.arena import arena  # noqa: E402

from impslam.evaluation.relations import RelationErrors  # noqa: E402

RUNS = ROOT / "runs" / "results"
PAGES = [ROOT / "README.md", ROOT / "docs" / "results.md"]
SIZE = 1000  # px of a picture, the longer side


def picture(name: str, folder: Path) -> None:
    """Copy a run's picture, scaled down, to the docs."""
    image = Image.open(folder / "report.png").convert("RGB")
    image.thumbnail((SIZE, SIZE))
    target = ROOT / "docs" / "images" / f"{name}.png"
    target.parent.mkdir(exist_ok=True)
    image.quantize(128, Image.Quantize.FASTOCTREE).save(target, optimize=True)
    size = target.stat().st_size / 1e3
    print(f"  {target.relative_to(ROOT)}: {size:.0f} kB")


def floor_plan(name: str, folder: Path) -> None:
    """Copy a run's grid to the docs, without areas seen by a few far beams."""
    grid = Image.open(folder / "map.pgm")
    rows, columns = np.nonzero(np.asarray(grid) == 0)
    low = [int(np.percentile(cells, 0.5)) - 40 for cells in (columns, rows)]
    high = [int(np.percentile(cells, 99.5)) + 40 for cells in (columns, rows)]
    target = ROOT / "docs" / "images" / f"{name}.png"
    grid.crop((*low, *high)).save(target, optimize=True)
    print(f"  {target.relative_to(ROOT)}: {target.stat().st_size / 1e3:.0f} kB")


def cm(metres: float) -> str:
    """Return a length in cm."""
    return f"{100 * metres:.1f} cm"


def demo(data: Path) -> str:
    """Map the arena once, with the first command of the docs."""
    del data
    from impslam.cli import main  # noqa: PLC0415  only here

    folder = RUNS / "demo"
    begin = time.perf_counter()
    assert main(["demo", "-o", str(folder), "--force", "--quiet"]) == 0
    picture("demo", folder)
    return f"{time.perf_counter() - begin:.0f} s"


def seeds(data: Path) -> str:
    """Map the arena with twenty seeds."""
    del data
    rows = arena(range(20), processes=os.cpu_count() or 1)
    median = {
        name: cm(np.median([row[name] for row in rows]))
        for name in ("cylinder", "wall", "end", "odometry_end")
    }
    return (
        f"{sum(row['kept'] for row in rows)} of 20 seeds within the limits; median over seeds: worst "
        f"cylinder {median['cylinder']}, worst wall {median['wall']}, end {median['end']} (wheels "
        f"alone {median['odometry_end']})"
    )


def known(function: Callable[[Path, Path], tuple[real_logs.Run, real_logs.Score]]) -> Callable:
    """Return the job of a log with known cylinders and path."""

    def job(data: Path) -> str:
        name = function.__name__
        seen, score = function(data, RUNS / name)
        picture(name, RUNS / name)
        found, all_ = len(score.cylinders.found), score.cylinders
        total = found + len(all_.missing)
        return (
            f"{found} of {total} cylinders, {len(all_.false) + len(all_.doubles)} false, "
            f"{cm(score.cylinder_rms)} RMS; path {cm(score.path.rmse)} RMS "
            f"(odometry alone {score.wheels.rmse:.2f} m); {seen.speed:.0f} times real time"
        )

    return job


def rover(name: str) -> Callable[[Path], str]:
    """Return the job of a log of the Mines rover."""

    def job(data: Path) -> str:
        log = data / "urg04lx-encoders" / f"{name}.dat"
        seen = real_logs.run_log(log, folder=RUNS / name)
        picture(name, RUNS / name)
        result = f"{len(seen.path)} scans, {len(seen.landmarks)} landmarks"
        if name == "exp1":
            laps = real_logs.laps(log, seen)
            offsets = real_logs.lap_offsets(laps, 300, 355)
            p50, p90 = np.percentile(offsets, (50, 90))
            same = np.percentile(real_logs.same_lap_offsets(laps, 300, 355), 90)
            result += (
                f"; walls of the second lap from those of the first: median {cm(p50)}, "
                f"90 % within {cm(p90)} ({len(offsets)} walls); of the same lap: {cm(same)}"
            )
        return f"{result}; {seen.speed:.0f} times real time"

    return job


def building(name: str) -> Callable[[Path], str]:
    """Return the job of a log with measured relations."""

    def job(data: Path) -> str:
        seen, errors, wheels = real_logs.relations(data, name, RUNS / name)
        picture(name, RUNS / name)
        enter(f"{name}-mean", f"{errors.translation.mean():.3f}")
        if name == "fr-hospital":
            local = real_logs.local_errors(data, name, seen.path)
            enter(f"{name}-local", f"{local.translation.mean():.3f}")
        return (
            f"{spread(errors, 4)}, worst {errors.translation.max():.2f} m; "
            f"odometry {spread(wheels)}; {seen.speed:.0f} times real time"
        )

    return job


def lidar_alone(name: str) -> Callable[[Path], str]:
    """Return the job of a log whose odometry is withheld."""

    def job(data: Path) -> str:
        _, errors, _ = real_logs.relations(data, name, settings=["odometry.kind=lidar_only"])
        return f"{errors.translation.mean():.3f}"

    return job


def fr101(data: Path) -> str:
    """Map a building without truth, for its picture."""
    seen = real_logs.run_log(data / "fr101" / "fr101.recovered.log", folder=RUNS / "fr101")
    floor_plan("fr101", RUNS / "fr101")
    return f"{len(seen.path)} scans; {seen.speed:.0f} times real time"


def car(name: str) -> Callable[[Path], str]:
    """Return the job of a log of the car."""
    job, figures, mark = outdoor.JOBS[name]

    def scored(data: Path) -> str:
        seen, score = job(data, RUNS / name)
        outdoor.picture(score, ROOT / "docs" / "images" / f"{name}.png", mark)
        return figures(seen, score)

    return scored


def spread(errors: RelationErrors, digits: int = 3) -> str:
    """Return mean and standard deviation in the format of the suite's tables."""
    m, degrees = errors.translation, np.degrees(errors.rotation)
    return (
        f"{m.mean():.{digits}f} ± {m.std():.{digits}f} m, {degrees.mean():.2f} ± {degrees.std():.2f}° "
        f"(medians {np.median(m):.3f} m, {np.median(degrees):.2f}°)"
    )


def ekf(data: Path) -> str:
    """Time a step of the filter with `ekf.py`."""
    del data
    script = [sys.executable, str(ROOT / "benchmarks" / "ekf.py")]
    said = subprocess.run(script, capture_output=True, text=True, check=True).stdout
    return "; ".join(map(_steps, said.split("\n\n")[1:]))


def _steps(table: str) -> str:
    """Return the text on one filter's steps for the docs."""
    rows = [line.split() for line in table.splitlines()]
    steps = {row[0]: row for row in rows if len(row) == 7 and row[0].isdigit()}
    times = ", ".join(f"{float(steps[n][4]):.2f} ms with {n}" for n in ("10", "100", "500"))
    return (
        f"`{rows[0][0]}` {times} and {float(steps['1000'][4]):.2f} ms with 1000 landmarks "
        f"({float(steps['1000'][6]):.1f} times the time of moving half of P through memory)"
    )


JOBS: dict[str, Callable[[Path], str]] = {
    "demo": demo,
    "seeds": seeds,
    "turtlebot3": known(real_logs.turtlebot3),
    "lego": known(real_logs.lego),
    "exp1": rover("exp1"),
    "exp2": rover("exp2"),
    "intel": building("intel"),
    "fr079": building("fr079"),
    "fr-hospital": building("fr-hospital"),
    "intel-lidar": lidar_alone("intel"),
    "fr079-lidar": lidar_alone("fr079"),
    "fr101": fr101,
    "carpark": car("carpark"),
    "victoria-park": car("victoria-park"),
    "ekf": ekf,
}


def enter(name: str, figures: str) -> None:
    """Replace the values of a name in the pages."""
    mark = re.compile(rf"(<!-- {re.escape(name)} -->).*?(<!-- / -->)", re.DOTALL)
    for page in PAGES:
        text = page.read_text("utf-8")
        page.write_text(mark.sub(lambda m: f"{m[1]}{figures}{m[2]}", text), "utf-8")


def main() -> None:
    """Run the jobs named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("names", nargs="*", help="default: all")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--list", action="store_true", help="print the names and end")
    arguments = parser.parse_args()
    if arguments.list:
        print(" ".join(JOBS))
        return
    for name in arguments.names or JOBS:
        figures = JOBS[name](arguments.data)
        print(f"{name}: {figures}", flush=True)
        enter(name, figures)


if __name__ == "__main__":
    main()
