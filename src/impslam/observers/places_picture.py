"""The picture of where scans were taken in a map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from impslam.evaluation import colours
from impslam.evaluation.colours import ODOMETRY, TRUTH
from impslam.maps.files import MapImage
from impslam.observers.canvas import Canvas, png
from impslam.observers.map_axes import CIRCLE, Key, MapAxes
from impslam.observers.map_picture import SIZE, draw_grid
from impslam.recognition.relocalisation import Answer, Verdict
from impslam.types import Array

FOUND, AMBIGUOUS = TRUTH, ODOMETRY
RADIUS, NEEDLE = 4.0, 11.0
"""Radius of a place's marker and length of its heading line, pixels."""


class Place(Protocol):
    """Where a scan was taken: see `impslam.localisation.Located`."""

    @property
    def pose(self) -> Array | None:
        """The best hypothesis (3,)."""

    @property
    def answer(self) -> Answer:
        """All hypotheses."""


def places_png(image: MapImage, places: Iterable[Place]) -> bytes:
    """Return a PNG of places on a map's grid; ambiguous ones are drawn at the best hypothesis."""
    left, right, bottom, top = image.extent
    margin = 0.03 * max(right - left, top - bottom, 1.0)
    bounds = left - margin, right + margin, bottom - margin, top + margin
    canvas = Canvas(bounds, SIZE, colours.UNSEEN)
    drawn = [place for place in places if place.pose is not None]
    groups = [
        (code, [p.pose for p in drawn if p.answer.verdict is verdict])
        for verdict, code in ((Verdict.AMBIGUOUS, AMBIGUOUS), (Verdict.FOUND, FOUND))
    ]
    keys = [
        Key(f"found ({len(groups[1][1])})", FOUND, outline=6.0 * CIRCLE),
        Key(f"ambiguous ({len(groups[0][1])}), best hypothesis", AMBIGUOUS, outline=6.0 * CIRCLE),
    ]
    frame = MapAxes(canvas, bounds, keys)
    draw_grid(canvas, image)
    frame.draw_lines()
    for code, poses in groups:
        for pose in poses:
            if pose is not None:
                _mark(canvas, pose, code)
    return png(frame.finished().pixels)


def _mark(canvas: Canvas, pose: Array, code: str) -> None:
    ahead = NEEDLE / canvas.scale * np.array([np.cos(pose[2]), np.sin(pose[2])])
    canvas.fill(pose[:2] + RADIUS / canvas.scale * CIRCLE, code)
    canvas.line(np.stack([pose[:2], pose[:2] + ahead]), code, 2.0)
