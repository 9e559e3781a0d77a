"""Writes the run folder: the same names always, and the same bytes for the same run but for times."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from impslam.errors import ImpError
from impslam.evaluation.landmark_files import TRUE_LANDMARKS, write_true_landmarks
from impslam.mapping.files import map_image, write_landmarks, write_map
from impslam.mapping.grid import OccupancyGrid
from impslam.observers.base import Observer, Outcome
from impslam.observers.grid_mapper import GridMapper
from impslam.observers.summary import Distance, config_toml, summarise
from impslam.observers.trajectory import TrajectoryWriter
from impslam.types import StepResult, TrueLandmark, TruePose


class Recorder(Observer):
    """Writes a run into a folder, which is made if need be.

    The path is written while it is driven; the map, landmarks.csv, summary.json and config.toml at
    the end, and truth.landmarks.csv where there are true landmarks. `grid` is one to go on with.

    Raises
    ------
    ImpError
        If the folder cannot be written to.
    """

    def __init__(
        self,
        folder: Path,
        resolution: float = 0.05,
        true_landmarks: Sequence[TrueLandmark] = (),
        grid: OccupancyGrid | None = None,
    ) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ImpError(
                f"{folder}: cannot be made ({error.strerror}); choose another -o"
            ) from None
        self._folder, self._known = folder, true_landmarks
        self._path, self._mapper, self._distance = (
            TrajectoryWriter(folder),
            GridMapper(resolution),
            Distance(),
        )
        if grid is not None:
            self._mapper.grid = grid

    @property
    def grid(self) -> OccupancyGrid:
        """The grid as it is by now, for observers that show it."""
        return self._mapper.grid

    def step(self, result: StepResult) -> None:
        """Record one scan."""
        for part in (self._path, self._mapper, self._distance):
            part.step(result)

    def truth(self, pose: TruePose) -> None:
        """Record a true pose."""
        self._path.truth(pose)

    def finish(self, outcome: Outcome) -> None:
        """Write what is known only at the end."""
        folder, grid = self._folder, self._mapper.grid
        self._path.finish(outcome)
        write_map(folder, map_image(grid))
        write_landmarks(folder / "landmarks.csv", outcome.landmarks)
        if self._known:
            write_true_landmarks(folder / TRUE_LANDMARKS, self._known)
        facts = summarise(outcome, self._distance, grid.refused)
        (folder / "summary.json").write_text(json.dumps(facts, indent=2, ensure_ascii=False) + "\n")
        (folder / "config.toml").write_text(config_toml(outcome.config), encoding="utf-8")
