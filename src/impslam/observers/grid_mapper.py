"""Builds the occupancy grid along the estimated path."""

from __future__ import annotations

from impslam.mapping.grid import OccupancyGrid
from impslam.observers.base import Observer
from impslam.types import StepResult


class GridMapper(Observer):
    """Enters every scan at the pose it has when it is seen; later corrections do not move it."""

    def __init__(self, resolution: float = 0.05) -> None:
        self.grid = OccupancyGrid(resolution)

    def step(self, result: StepResult) -> None:
        """Enter a scan."""
        if result.scan is not None:
            self.grid.enter(result.scan_pose, result.scan)
