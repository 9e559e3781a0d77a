"""Variation of the consistency study by chance: the same study with several base seeds.

    python benchmarks/consistency.py --seeds 5 --runs 400                # riekf
    python benchmarks/consistency.py --seeds 20 --runs 50 --filter ekf   # as short as published ones

A perfect filter has 95 % of its steps in the 95 % band on average over base seeds. All steps of a run have
the first turn's error in common, so in a single study the share may be above 95 % or well below it by
chance. The last line is the result of a perfect filter, simulated by drawing its NEES: one degree of
freedom is constant over a run, two vary.
"""

from __future__ import annotations

import argparse
import os

import numpy as np

from impslam.evaluation.consistency import share_within
from impslam.studies.circle_simulation import HUANG
from impslam.studies.filter_consistency import FilterResult, consistency_study
from impslam.sweeps.job import Job
from impslam.types import Array

FIRST = 1
"""First base seed; 0 is that of `imp reproduce consistency`."""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    options.add_argument("--seeds", type=int, default=5)
    options.add_argument("--runs", type=int, default=400)
    options.add_argument("--filter", default="riekf")
    options.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = options.parse_args()
    print(f"{given.filter}, {given.runs} runs a seed")
    print("seed  first turn   NEES  in band  position / optimum  position  heading")
    rows = []
    for seed in range(FIRST, FIRST + given.seeds):
        row, first_turn = study(given.filter, given.runs, seed, given.jobs)
        rows.append(row)
        print(
            f"{seed:4d} {first_turn:11.3f} {row.nees:6.3f} {row.in_band:8.1%}"
            f" {row.position_ratio:19.4f}"
            f" {row.position:7.3f} m {np.degrees(row.heading):5.2f} deg",
            flush=True,
        )
    bands = np.array([row.in_band for row in rows])
    nees = np.array([row.nees for row in rows])
    print(
        f"mean in band {bands.mean():.1%}, lowest {bands.min():.1%}, highest {bands.max():.1%}; "
        f"95 % or more in {(bands >= 0.95).sum()} of {len(bands)}; "
        f"NEES {nees.mean():.3f}, standard deviation {nees.std(ddof=1):.3f}"
    )
    ideal = perfect(given.runs)
    low, middle = np.quantile(ideal, [0.05, 0.5])
    print(
        f"a perfect filter: mean in band {ideal.mean():.1%}, median {middle:.1%}, one study in twenty "
        f"below {low:.1%}; 95 % or more in {(ideal >= 0.95).mean():.0%} of studies"
    )


def perfect(runs: int, studies: int = 2000) -> Array:
    """Return the shares (studies,) of steps in the band of a perfect filter."""
    rng = np.random.default_rng(0)
    constant = rng.chisquare(runs, studies) / runs
    varying = rng.chisquare(2 * runs, (studies, HUANG.steps - 1)) / runs
    return np.array([share_within(nees, runs, 3) for nees in constant[:, None] + varying])


def study(name: str, runs: int, seed: int, processes: int) -> tuple[FilterResult, float]:
    """Return a filter's row of a study with a base seed, and the mean square of its first turns."""
    done = consistency_study([name], runs, seed, HUANG, Job(processes=processes))
    return done.rows[0], done.first_turn


if __name__ == "__main__":
    main()
