"""The picture of the changes between two maps: gone in red, new in blue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.evaluation import colours
from impslam.evaluation.colours import INK, PATH, WALL
from impslam.maps.changes import Change, Changes
from impslam.maps.files import MapImage
from impslam.observers.canvas import Canvas, png
from impslam.observers.map_axes import SQUARE, Key, MapAxes
from impslam.observers.map_picture import LABEL_SIZE, MAX_LABELS, SIZE, draw_grid

GONE, NEW = PATH, WALL
MIN_HALF_CELL = 2.5
"""Minimum of half a cell's side, pixels, to keep changes visible on the picture of a building."""


def changes_png(image: MapImage, found: Changes) -> bytes:
    """Return a PNG of the changes on the later map's grid, numbered as in the table."""
    left, right, bottom, top = image.extent
    cells = [change.cells for change in (*found.gone, *found.new)]
    points = np.vstack([[[left, bottom], [right, top]], *cells])
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * max(x1 - x0, y1 - y0, 1.0)
    bounds = x0 - margin, x1 + margin, y0 - margin, y1 + margin
    canvas = Canvas(bounds, SIZE, colours.UNSEEN)
    keys = [Key("gone", GONE, outline=9.0 * SQUARE), Key("new", NEW, outline=9.0 * SQUARE)]
    frame = MapAxes(canvas, bounds, keys)
    draw_grid(canvas, image)
    frame.draw_lines()
    for pieces, code in ((found.gone, GONE), (found.new, NEW)):
        _draw(canvas, pieces, code, image.resolution)
    for number, change in enumerate((*found.gone, *found.new)[:MAX_LABELS], 1):
        canvas.label(change.position + 9.0 / canvas.scale, str(number), INK, LABEL_SIZE, "#ffffff")
    return png(frame.finished().pixels)


def _draw(canvas: Canvas, pieces: Sequence[Change], code: str, resolution: float) -> None:
    half = max(0.5 * resolution, MIN_HALF_CELL / canvas.scale)
    for piece in pieces:
        for cell in piece.cells:
            canvas.fill(cell + half * SQUARE, code)
