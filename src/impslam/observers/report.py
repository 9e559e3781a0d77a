"""Writes report.html, one page that needs nothing else, and report.png, its picture of the map."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from impslam.mapping.files import MapImage, map_image
from impslam.mapping.grid import OccupancyGrid
from impslam.observers import accuracy
from impslam.observers.base import Observer, Outcome
from impslam.observers.grid_mapper import GridMapper
from impslam.observers.history import History
from impslam.observers.map_picture import Scene, map_png
from impslam.observers.page import page, section
from impslam.observers.sections import (
    details,
    dropped,
    heading,
    landmark_table,
    matching,
    stages,
    uncertainty,
)
from impslam.types import Landmark, StepResult, TrueLandmark, TruePose


class Report(Observer):
    """Draws the run and tells what came of it.

    Parameters
    ----------
    folder : where report.html and report.png go; it must exist when the run ends
    grid : the grid that another observer builds along the run; without one the report builds it
    truth_landmarks : what is really there, in the truth's frame, where that is known
    history : of the scans before, where the report begins in the middle of a run
    """

    def __init__(
        self,
        folder: Path,
        grid: OccupancyGrid | None = None,
        truth_landmarks: Sequence[TrueLandmark] = (),
        history: History | None = None,
    ) -> None:
        self._folder, self._known = folder, truth_landmarks
        self._history = History() if history is None else history
        self._mapper = GridMapper() if grid is None else None
        self._grid = grid if self._mapper is None else self._mapper.grid

    def step(self, result: StepResult) -> None:
        """Remember a scan."""
        self._history.step(result)
        if self._mapper is not None:
            self._mapper.step(result)

    def truth(self, pose: TruePose) -> None:
        """Remember a true pose."""
        self._history.truth(pose)

    def finish(self, outcome: Outcome) -> None:
        """Write the page and the picture."""
        assert self._grid is not None
        history = self._history
        laid = accuracy.laid_in_map(history)
        truth = np.zeros((0, 2)) if laid is None else laid.pairs.truth[:, :2]
        picture = draw(map_image(self._grid), history, truth, outcome.landmarks)
        (self._folder / "report.png").write_bytes(picture)
        sections = [
            heading(outcome, history),
            section("Map", _image(picture), note=MAP_NOTE),
            accuracy.section_of(laid, history, outcome.landmarks, self._known),
            uncertainty(history),
            landmark_table(outcome.landmarks),
            matching(history),
            '<div class="columns">' + stages(outcome) + dropped(outcome) + "</div>",
            details(outcome),
        ]
        text = page(f"{outcome.log.name} · impslam", sections)
        (self._folder / "report.html").write_text(text, encoding="utf-8")


MAP_NOTE = (
    "White is free, grey is occupied, pale grey was never seen. Ellipses hold a point with 98.9 % "
    "probability (3σ). Numbers, where there are few, are those of the landmark table."
)


def draw(
    image: MapImage, history: History, truth: np.ndarray, landmarks: Sequence[Landmark]
) -> bytes:
    """Return the picture of the map as a PNG."""
    path, odometry = history.path[:, 1:3], history.odometry[:, 1:3]
    return map_png(Scene(image, path, odometry, truth, landmarks))


def _image(png: bytes) -> str:
    data = base64.b64encode(png).decode()
    words = "Occupancy grid with the estimated path, dead reckoning and the landmarks"
    return f'<img class="map" alt="{words}" src="data:image/png;base64,{data}">'
