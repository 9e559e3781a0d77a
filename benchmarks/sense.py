"""CPU time of sensing: odometry and a lidar of 180 beams, from columns to sweeps with their motion.

    python benchmarks/sense.py

In one process, after warm-up: us per row of odometry and per sweep in batches of 512 rows, from two
mixtures of both; and per batch of one row, as on a live robot.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from impslam.columns import ROWS, Batch, Columns, single_row  # noqa: E402  from the root
from impslam.config import load  # noqa: E402
from impslam.robot import Robot  # noqa: E402
from impslam.types import Ints, LaserScan, WheelAngles  # noqa: E402

BEAMS, PERIOD, REPEAT = 180, 0.01, 60
WARM = 10  # batches
ANGLES = np.linspace(-1.5, 1.5, BEAMS)
LAYOUT = {"angles": ANGLES, "time_offsets": 1e-4 * np.arange(BEAMS)}
LIMITS = {"range_min": 0.02, "range_max": 5.6, "intensities": None}


def mixed(number: int, every: int) -> Batch:
    """Return the number-th batch, in which every n-th row is a sweep and the others wheels."""
    order = np.arange(number * ROWS, (number + 1) * ROWS)
    sweep = order % every == every - 1
    return {"wheels": wheels(order[~sweep]), "lidar": sweeps(order[sweep])}


def wheels(order: Ints) -> Columns:
    """Return rows of a robot that turns left."""
    stamps = PERIOD * order
    values = {"stamp": stamps, "left": 3.0 * stamps, "right": 3.5 * stamps}
    return Columns("wheels", WheelAngles, order, values, {})


def sweeps(order: Ints) -> Columns:
    """Return sweeps of `BEAMS` beams."""
    ranges = np.random.default_rng(0).uniform(0.5, 5.0, (len(order), BEAMS))
    values = {"stamp": PERIOD * order, "ranges": ranges}
    return Columns("lidar", LaserScan, order, values, {**LAYOUT, **LIMITS})


def seconds(robot: Robot, log: Sequence[Batch]) -> float:
    """Return the CPU time of sensing, s for a batch."""
    for part in log[:WARM]:
        list(robot.sense(part))
    begin = time.process_time()
    for part in log[WARM:]:
        list(robot.sense(part))
    return (time.process_time() - begin) / len(log[WARM:])


def one_by_one() -> list[Batch]:
    """Return batches of one row: nine of odometry, one sweep."""
    numbers = np.arange(REPEAT * 50)
    rows = [wheels(numbers[k : k + 1]) if k % 10 else sweeps(numbers[k : k + 1]) for k in numbers]
    return [single_row(row.stream, row.row(0), k) for k, row in enumerate(rows)]


def main() -> None:
    """Print the three times."""
    costs = [
        seconds(load("imp").make_robot(), [mixed(k, every) for k in range(REPEAT)]) * 1e6
        for every in (2, 100)
    ]
    shares = [[ROWS - ROWS // every, ROWS // every] for every in (2, 100)]
    row, sweep = np.linalg.solve(np.array(shares), np.array(costs))
    alone = seconds(load("imp").make_robot(), one_by_one()) * 1e6
    print(
        f"{row:.2f} us a row of odometry, {sweep:.2f} us a sweep; {alone:.0f} us a batch of one row"
    )


if __name__ == "__main__":
    main()
