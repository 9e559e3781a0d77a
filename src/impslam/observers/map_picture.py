"""The picture of a run: grid, paths and landmarks, with axes and a key."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from impslam.evaluation import colours
from impslam.evaluation.colours import INK, ODOMETRY, PATH, POINT, SIGMAS, TRUTH, WALL
from impslam.map import Map
from impslam.maps.files import FREE, OCCUPIED, MapImage
from impslam.observers.canvas import Canvas, Picture, colour, png
from impslam.observers.map_axes import CIRCLE, SQUARE, Key, MapAxes
from impslam.types import Array, Landmark

SIZE = 1440
"""Length of the map's longer side, pixels."""
LABEL_SIZE = 0.55
"""Font size of the landmarks' numbers in OpenCV's units."""
MAX_POINTS = 4000
"""Maximum number of drawn points of a path: more than it has pixels."""
MAX_LABELS = 40
"""Maximum number of labelled landmarks; more would hide the map."""
STRAY_SHARE, MIN_CELLS = 0.5, 1000
"""Percent of the occupied cells at each side that may be left out of the picture, and the number of cells
that this needs: beams through windows and glass would make the map small."""
DASH, GAP = 11.0, 7.0
"""Length of the true path's dashes and gaps, pixels."""
MAX_STRETCH = 2.0
"""Factor by which the picture, with ellipses and odometry, may exceed map, path and truth; beyond that, the
map would be too small."""


@dataclass(frozen=True, slots=True, eq=False)
class PictureContent:
    """The items to draw; paths are (n, 2) m in map, empty if unknown, interrupted at non-finite rows."""

    image: MapImage
    path: Array
    odometry: Array
    truth: Array
    landmarks: Sequence[Landmark]


def map_png(scene: PictureContent) -> bytes:
    """Return the map with paths and landmarks as a PNG."""
    left, right, bottom, top = box = bounds(scene)
    canvas = Canvas(box, SIZE, colours.UNSEEN)
    frame = MapAxes(canvas, box, _keys(scene))
    draw_grid(canvas, scene.image)
    frame.draw_lines()
    thickness = float(np.clip(15.0 / max(right - left, top - bottom), 0.5, 1.0))
    _draw_paths(canvas, scene, thickness)
    _draw_landmarks(canvas, scene.landmarks, thickness)
    _draw_ends(canvas, scene.path)
    _draw_numbers(canvas, scene.landmarks)
    return png(frame.finished().pixels)


def bounds(scene: PictureContent) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of the drawn items, limited by `MAX_STRETCH`."""
    ends = [mark.end_points for mark in scene.landmarks if mark.end_points is not None]
    points = [mark for mark in scene.landmarks if mark.end_points is None]
    at = [mark.position[None] for mark in points]
    box = _box(scene.path, scene.truth, *ends, *at, _seen(scene.image))
    left, right, bottom, top = scene.image.extent
    max_side = MAX_STRETCH * max(np.ptp(box, axis=0).max(), right - left, top - bottom)
    for more in ([ellipse(mark) for mark in points], [scene.odometry]):
        wider = _box(box, *more)
        if np.ptp(wider, axis=0).max() <= max_side:
            box = wider
    low, high = box
    margin = 0.03 * max(*(high - low), 1.0)
    return low[0] - margin, high[0] + margin, low[1] - margin, high[1] + margin


def _seen(image: MapImage) -> Array:
    """Return the corners (2, 2) m of the occupied cells, without stray beams; or of all known cells."""
    left, right, bottom, top = image.extent
    rows, columns = np.nonzero(image.pixels == OCCUPIED)
    if len(rows) < MIN_CELLS:
        return np.array([[left, bottom], [right, top]])
    cells = np.array([left, top]) + image.resolution * np.column_stack((columns, -rows))
    return np.asarray(np.percentile(cells, (STRAY_SHARE, 100.0 - STRAY_SHARE), axis=0))


def _box(*parts: Array) -> Array:
    """Return the lower left and upper right corners (2, 2) of the finite points of all parts (n, 2)."""
    points = np.vstack(parts)
    points = points[np.isfinite(points).all(axis=1)]
    return np.stack([points.min(axis=0), points.max(axis=0)])


def ellipse(mark: Landmark) -> Array:
    """Return the uncertainty ellipse (n, 2) m of a point at `SIGMAS` standard deviations."""
    values, vectors = np.linalg.eigh(mark.covariance)
    axes = SIGMAS * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(mark.position + CIRCLE * axes @ vectors.T)


def draw_grid(canvas: Canvas, image: MapImage) -> None:
    """Draw a map's free, occupied and unseen cells."""
    greys: Picture = np.full((256, 3), colour(colours.UNSEEN), np.uint8)
    greys[FREE], greys[OCCUPIED] = colour(colours.FREE), colour(colours.SEEN)
    left, _, _, top = image.extent
    canvas.paste(greys[image.pixels], left, top, image.resolution)


def _draw_paths(canvas: Canvas, scene: PictureContent, thickness: float) -> None:
    walls = [mark.end_points for mark in scene.landmarks if mark.end_points is not None]
    for piece in pieces(scene.odometry):
        canvas.line(piece, ODOMETRY, 2.7 * thickness)
    before = canvas.pixels.copy()
    for ends in walls:
        canvas.line(ends, WALL, 8.0 * thickness)
    canvas.fade(before, 0.75)
    for piece in pieces(scene.path):
        canvas.line(piece, PATH, 4.0 * thickness)
    for piece in pieces(scene.truth):
        canvas.dashes(piece, TRUTH, 2.7, DASH, GAP)


def drawn_path(known: Map) -> Array:
    """Return a map's path (n, 2) m, with a row of NaN between two sessions."""
    path, sessions = known.rows().poses[:, :2], known.keyframes.sessions[known.anchors]
    begins = np.flatnonzero(np.diff(sessions[known.placed()])) + 1
    return np.insert(path, begins, np.nan, axis=0)


def pieces(path: Array) -> Iterator[Array]:
    """Yield the finite pieces of a path; long ones are thinned to every k-th point and the last."""
    step = -(-len(path) // MAX_POINTS)
    known = np.isfinite(path).all(axis=1)
    for piece in np.split(path, np.flatnonzero(np.diff(known)) + 1):
        if len(piece) and np.isfinite(piece[0]).all():
            yield np.vstack((piece[:-1:step], piece[-1])) if step > 1 else piece


def _draw_landmarks(canvas: Canvas, landmarks: Sequence[Landmark], thickness: float) -> None:
    """Draw point landmarks: outline, cross and uncertainty ellipse."""
    points = [mark for mark in landmarks if mark.end_points is None]
    before = canvas.pixels.copy()
    for mark in points:
        canvas.fill(mark.position + mark.parameters.get("radius", 0.05) * CIRCLE, POINT)
    canvas.fade(before, 0.35)
    arm = 6.0 / canvas.scale
    for mark in points:
        for cross in (np.array([[-arm, 0.0], [arm, 0.0]]), np.array([[0.0, -arm], [0.0, arm]])):
            canvas.line(mark.position + cross, POINT, 2.0 * thickness)
        canvas.line(ellipse(mark), POINT, 2.0 * thickness, closed=True)


def _draw_ends(canvas: Canvas, path: Array) -> None:
    """Mark the start and the end of the path."""
    path = path[np.isfinite(path).all(axis=1)]
    if not len(path):
        return
    for position, outline, code in ((path[0], CIRCLE, TRUTH), (path[-1], SQUARE, INK)):
        canvas.fill(position + 11.0 / canvas.scale * outline, "#ffffff")
        canvas.fill(position + 8.5 / canvas.scale * outline, code)


def _draw_numbers(canvas: Canvas, landmarks: Sequence[Landmark]) -> None:
    """Write the landmarks' numbers beside them, if they are few."""
    for mark in landmarks if len(landmarks) <= MAX_LABELS else ():
        at = mark.position if mark.end_points is None else mark.end_points.mean(axis=0)
        canvas.label(at + 9.0 / canvas.scale, str(mark.id), INK, LABEL_SIZE, "#ffffff")


def _keys(scene: PictureContent) -> list[Key]:
    """Return the key's entries for the items in the scene."""
    kinds = {mark.end_points is None for mark in scene.landmarks}
    entries = [
        (True, Key("SLAM", PATH, 4.0)),
        (len(scene.odometry) > 0, Key("odometry", ODOMETRY, 3.0)),
        (len(scene.truth) > 0, Key("truth", TRUTH, 3.0)),
        (False in kinds, Key("wall", WALL, 8.0)),
        (True in kinds, Key("point, 3 sigma", POINT, 2.0, 9.0 * CIRCLE)),
        (True, Key("start", TRUTH, outline=9.0 * CIRCLE)),
        (True, Key("end", INK, outline=8.0 * SQUARE)),
    ]
    return [key for is_shown, key in entries if is_shown]
