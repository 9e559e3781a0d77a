"""Writes report.html, a self-contained page, and report.png, its picture of the map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from impslam.maps.files import MapImage
from impslam.observers import accuracy
from impslam.observers.base import Outcome
from impslam.observers.health_band import health_section
from impslam.observers.history import History
from impslam.observers.map_picture import PictureContent, drawn_path, map_png
from impslam.observers.page import page
from impslam.observers.quality_section import quality_section
from impslam.observers.sections import (
    details,
    dropped,
    heading,
    landmark_table,
    matching,
    stages,
    uncertainty,
)
from impslam.observers.viewer import map_section, script
from impslam.types import Landmark, TrueLandmark


def write_report(
    folder: Path,
    history: History,
    outcome: Outcome,
    image: MapImage,
    true_landmarks: Sequence[TrueLandmark] = (),
) -> None:
    """Write the page and the picture to a folder; `true_landmarks` are in the truth's frame."""
    landmarks = history.known.landmarks
    aligned = accuracy.align_truth(history)
    truth = np.zeros((0, 2)) if aligned is None else aligned.pairs.truth[:, :2]
    (folder / "report.png").write_bytes(draw(image, history, truth, landmarks))
    sections = _sections(history, outcome, image, aligned, true_landmarks)
    with (folder / "report.html").open("w", encoding="utf-8") as file:
        file.writelines(page(f"{outcome.log.name} · impslam", sections, script()))


def _sections(
    history: History,
    outcome: Outcome,
    image: MapImage,
    aligned: accuracy.AlignedTruth | None,
    true_landmarks: Sequence[TrueLandmark],
) -> Iterator[str]:
    """Yield the sections one by one, because that of the map takes megabytes."""
    landmarks = history.known.landmarks
    yield heading(outcome, history)
    yield map_section(history, outcome, image, aligned)
    yield health_section(outcome.health)
    yield accuracy.accuracy_section(aligned, history, landmarks, true_landmarks)
    yield quality_section(history.quality)
    yield uncertainty(history)
    yield landmark_table(landmarks)
    yield matching(history)
    yield '<div class="columns">' + stages(outcome) + dropped(outcome) + "</div>"
    yield details(outcome)


def draw(
    image: MapImage, history: History, truth: np.ndarray, landmarks: Sequence[Landmark]
) -> bytes:
    """Return the picture of the map as a PNG."""
    path, odometry = drawn_path(history.known), history.odometry[:, 1:3]
    return map_png(PictureContent(image, path, odometry, truth, landmarks))
