"""The sweeps of a lidar on a body that moves in real time."""

from __future__ import annotations

import numpy as np

from impslam.simulation.body import MEMORY, STEP, Body
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.robot import Lidar
from impslam.types import Array

SPEED_TOLERANCE = 1e-3
"""Relative excess of a motor's speed over the one of `Lidar`: ten times that of a bad crystal. The beam
time of `Lidar` is also rounded, to 4e-5."""


class LidarSweeps:
    """The sweeps of the lidar on a body."""

    def __init__(self, body: Body, seed: int = 0, lidar: Lidar | None = None) -> None:
        self._body = body
        rng = np.random.default_rng(seed)
        self._simulator = LidarSimulator(
            lidar or body.robot.lidar or Lidar(), body.scene, body, rng
        )

    def ranges(self, time: float) -> Array:
        """Return the ranges (n,) of the sweep that began at `time`, m; 0: no echo.

        Raises
        ------
        ValueError
            If the sweep has not ended yet, or began before the body's stored past.
        """
        now, duration = self._body.time, self._simulator.duration * (1.0 - SPEED_TOLERANCE)
        # The body's time is rounded down to STEP.
        if not now - MEMORY + STEP <= time <= now - duration + STEP:
            raise ValueError(f"a sweep that began at {time:.3f} s cannot be read at {now:.3f} s")
        return self._simulator.ranges(time)
