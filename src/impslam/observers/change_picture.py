"""The picture of what has changed between two maps: gone red, new blue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.evaluation import colours
from impslam.evaluation.colours import INK, PATH, WALL
from impslam.maps.changes import Change, Changes
from impslam.maps.files import MapImage
from impslam.observers.canvas import Canvas, png
from impslam.observers.map_frame import SQUARE, Frame, Key
from impslam.observers.map_picture import MAX_LABELS, SIZE, SMALL, draw_grid

GONE, NEW = PATH, WALL
LEAST = 2.5
"""Pixels: half a cell's side at least, so that a change is seen on a picture of a building."""


def changes_png(image: MapImage, found: Changes) -> bytes:
    """Return the changes on the later map's grid, numbered as in the table, as a PNG."""
    left, right, bottom, top = image.extent
    cells = [change.cells for change in (*found.gone, *found.new)]
    places = np.vstack([[[left, bottom], [right, top]], *cells])
    (x0, y0), (x1, y1) = places.min(axis=0), places.max(axis=0)
    margin = 0.03 * max(x1 - x0, y1 - y0, 1.0)
    bounds = x0 - margin, x1 + margin, y0 - margin, y1 + margin
    canvas = Canvas(bounds, SIZE, colours.UNSEEN)
    keys = [Key("gone", GONE, outline=9.0 * SQUARE), Key("new", NEW, outline=9.0 * SQUARE)]
    frame = Frame(canvas, bounds, keys)
    draw_grid(canvas, image)
    frame.rule()
    for pieces, code in ((found.gone, GONE), (found.new, NEW)):
        _draw(canvas, pieces, code, image.resolution)
    for number, change in enumerate((*found.gone, *found.new)[:MAX_LABELS], 1):
        canvas.label(change.position + 9.0 / canvas.scale, str(number), INK, SMALL, "#ffffff")
    return png(frame.around().pixels)


def _draw(canvas: Canvas, pieces: Sequence[Change], code: str, resolution: float) -> None:
    half = max(0.5 * resolution, LEAST / canvas.scale)
    for piece in pieces:
        for cell in piece.cells:
            canvas.fill(cell + half * SQUARE, code)
