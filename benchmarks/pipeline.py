"""Time per scan of the whole pipeline, by stage, against the beams of a scan and the size of the map.

    python benchmarks/pipeline.py

The arena is simulated with lidars of several resolutions and mapped, with its own landmarks only and with
many more elsewhere. "kernels" is the time in compiled code (numba and BLAS), "python" the rest:
interpreter, numpy on small arrays, bookkeeping. Reading a log is not included. Times are means over all
scans after warm-up.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import Any

for _library in ("OPENBLAS", "MKL", "OMP"):  # one core
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np

from impslam.columns import batches
from impslam.config import load
from impslam.filters import belief
from impslam.filters.blas import subtract_product
from impslam.geometry.kernels import Kernel
from impslam.run import Run
from impslam.simulation.robot import Lidar, SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Message, Observation

BEAMS = (180, 360, 682)
ELSEWHERE = (0, 100, 300)  # landmarks
SPAN = 340.0 * 2.0 * np.pi / 1024.0  # rad to each side, of the URG-04LX
SECONDS = 40.0


class Kernels:
    """Accumulates the time spent in compiled code called from Python."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def watch(self) -> None:
        """Time every kernel of the package from now on; each must have been compiled before."""
        for name, module in list(sys.modules.items()):
            if name.startswith("impslam."):
                for key, value in list(vars(module).items()):
                    if isinstance(value, Kernel):
                        setattr(module, key, self._timed(value))
        setattr(belief, subtract_product.__name__, self._timed(subtract_product))

    def _timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            result = function(*args, **named)
            self.seconds += time.perf_counter() - begin
            return result

        return timed


def main() -> None:
    logs = {beams: record(beams) for beams in BEAMS}
    kernels = Kernels()
    for log in logs.values():  # compiles, or loads what is compiled
        measure(log, 0, kernels)
    kernels.watch()
    rows = {(b, e): measure(log, e, kernels) for b, log in logs.items() for e in ELSEWHERE}
    print("ms per scan, means")
    print("beams  elsewhere  " + "  ".join(f"{name:>8}" for name in next(iter(rows.values()))))
    for (beams, elsewhere), row in rows.items():
        print(f"{beams:5d}  {elsewhere:9d}  " + "  ".join(f"{ms:8.3f}" for ms in row.values()))


def record(beams: int) -> list[Message]:
    """Return the robot's recording in the arena with a lidar of `beams` beams."""
    lidar = Lidar(beams=beams, angle_min=-SPAN, angle_step=2.0 * SPAN / (beams - 1))
    messages = simulate(load_world("arena"), SimulatedRobot(lidar=lidar))
    first = next(messages)
    return [first, *takewhile(lambda message: message.stamp < first.stamp + SECONDS, messages)]


def measure(log: Sequence[Message], elsewhere: int, kernels: Kernels) -> dict[str, float]:
    """Return means over scans, in ms, by name; the first scans are left out."""
    run = Run(load("imp"))
    far = np.random.default_rng(0).uniform(100.0, 200.0, (elsewhere, 2))
    run.estimator._filter.extend(  # type: ignore[attr-defined]
        [Observation("cylinder", p, np.eye(2) * 1e-4) for p in far], 0.0
    )
    parts = list(batches((type(message).__name__, message) for message in log))
    run.feed(parts[0])
    before, scans = stage_seconds(run), run.scans
    begin, compiled = time.perf_counter(), kernels.seconds
    for part in parts[1:]:
        run.feed(part)
    total, within = time.perf_counter() - begin, kernels.seconds - compiled
    table = {name: s - before[name] for name, s in stage_seconds(run).items()}
    table |= {"total": total, "kernels": within, "python": total - within}
    return {name: 1e3 * seconds / (run.scans - scans) for name, seconds in table.items()}


def stage_seconds(run: Run) -> dict[str, float]:
    """Return the seconds spent in each stage so far."""
    return {name: sum(times) for name, times in run.clock.stages.items()}


if __name__ == "__main__":
    main()
