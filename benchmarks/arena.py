"""Errors in the thesis's arena against limits, for the tests and the values in the README.

python benchmarks/arena.py --seeds 20 --preset imp --set filter.kind=ekf    # print a row per run
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence

from impslam.studies.arena_experiment import NAMED, landmark_metrics
from impslam.studies.sweep import Variant, sweep
from impslam.sweeps.job import Job
from impslam.sweeps.rows import Row

LIMITS = {"cylinder": 0.03, "wall": 0.02, "end": 0.03}
"""m, limits for the default preset; a wall's error is perpendicular, at its middle."""


def arena(
    seeds: Iterable[int], preset: str = "imp", settings: Sequence[str] = (), processes: int = 1
) -> list[Row]:
    """Simulate and map the arena; return a row for each seed, with its worst errors in m.

    `cylinder` and `wall` are infinite if one of either is missing; `kept` is whether all errors are within
    the limits and nothing in the map is false, including corners.
    """
    variant = Variant(preset, preset, tuple(settings))
    rows = sweep([variant], seeds, measure=landmark_metrics, job=Job(processes=processes))
    for row in rows:
        for kind in ("cylinder", "wall"):
            errors = [row.get(f"distance {n}", math.inf) for n in NAMED if n.startswith(kind)]
            row[kind] = max(errors)
        within = all(row.get(name, math.inf) <= limit for name, limit in LIMITS.items())
        row["kept"] = within and not row["false"]
    return rows


def main() -> None:
    """Print a row for each seed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--preset", default="imp")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    rows = arena(range(given.seeds), given.preset, given.set, given.jobs)
    print("seed  cylinder    wall     end  wheels  kept")
    for row in rows:
        names = ("cylinder", "wall", "end", "odometry_end")
        errors = [f"{row.get(name, math.nan):8.3f}" for name in names]
        print(f"{row['seed']:4d}  {''.join(errors)}  {row['error'] or row['kept']}")


if __name__ == "__main__":
    main()
