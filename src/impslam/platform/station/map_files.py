"""The run folder of a map that is still growing: the same files as those of a log's run."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

from impslam.errors import ImpError
from impslam.mapping.grid import OccupancyGrid
from impslam.observers.base import Outcome
from impslam.observers.grid_picture import frozen
from impslam.observers.history import History
from impslam.observers.recorder import Recorder
from impslam.observers.report import Report


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """A map at one moment, all parts of it of the same scan; it grows no more."""

    outcome: Outcome
    history: History
    grid: OccupancyGrid


def draft(outcome: Outcome, history: History, grid: OccupancyGrid) -> Draft:
    """Return a copy of what grows; call it between two scans."""
    return Draft(outcome, copy.deepcopy(history), frozen(grid))


def write(folder: Path, made: Draft) -> Path:
    """Write the run folder and return it.

    Raises
    ------
    ImpError
        If it cannot be written.
    """
    recorder = Recorder(folder, made.grid.resolution, grid=made.grid)
    report = Report(folder, made.grid, history=made.history)
    try:
        for result in made.history.results():
            recorder.step(result)
        recorder.finish(made.outcome)
        report.finish(made.outcome)
    except OSError as error:
        raise ImpError(f"{folder}: cannot be written ({error.strerror})") from None
    return folder
