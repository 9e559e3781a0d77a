"""Bags of typical slam_toolbox users, each mapped as by `imp run BAG`: error of the path.

    python benchmarks/ros_bags.py [WORLD]      # default: arena, 78 s

The simulator writes the recordings of the robots of `tests/sources/ros_recipes.py`: their frames, odometry
and lidars. Errors are distances from the truth after a rigid fit.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))  # the bags are those of the tests

from tests.sources.ros_recipes import BAGS
from tests.sources.ros_robots import drive, write

from impslam.config_from_log import choices
from impslam.evaluation.trajectory import associate, ate
from impslam.open_log import open_log
from impslam.run import map_log
from impslam.simulation.world import load_world


def main(world: str = "arena") -> None:
    """Print a line for each bag."""
    print(f"{'bag':28} {'scans':>6} {'rms, cm':>8} {'worst, cm':>10} {'CPU, s':>7}  reads")
    for name, (recipe, _) in BAGS.items():
        entries, truth = drive(load_world(world), recipe)
        with tempfile.TemporaryDirectory() as folder:
            log = write(Path(folder) / "bag", recipe, entries)
            begin = time.process_time()
            config, source = open_log(log)
            path = map_log(config, source).path()
            seconds = time.process_time() - begin
        error = ate(associate(path, truth))
        rms, worst = 100 * error.rmse, 100 * error.max
        said = choices(config, source)
        print(f"{name:28} {len(path):6} {rms:8.2f} {worst:10.2f} {seconds:7.2f}  {said}")


if __name__ == "__main__":
    main(*sys.argv[1:])
