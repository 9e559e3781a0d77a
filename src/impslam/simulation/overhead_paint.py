"""Paints the pictures of the overhead camera.

Objects that are measured in the pictures (markers, discs, boards) are sampled at sub-pixels along the
camera's rays, so that their edges are exact; the rest is drawn as polygons.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from impslam.overhead.camera import EXTRINSIC, LENS, CalibratedCamera
from impslam.types import Array

Pixels = npt.NDArray[np.uint8]
Canvas = npt.NDArray[np.float32]
Paint = Callable[[Canvas, Canvas], Canvas]
"""Colours and opacity (..., 4), blue, green, red 0 to 255 and 0 to 1, of points x, y (...) m."""
SAMPLES = 4  # per side of a pixel; 2 suffice for edges as long as those of a board's square
FRACTION_BITS = 4  # fractional bits of the polygons' pixel coordinates

Box = tuple[slice, slice]
"""Rows and columns of a picture."""


class Brush:
    """Paints into the picture of a camera; see `CalibratedCamera` for its vector."""

    def __init__(self, camera: CalibratedCamera, rays: Canvas | None = None) -> None:
        self.camera = camera
        self._rays = _rays(camera) if rays is None else rays

    def with_extrinsics(self, extrinsics: Array) -> Brush:
        """Return a brush for the same lens with other extrinsics (6,)."""
        camera = self.camera
        vector = np.concatenate([extrinsics, camera.vector[LENS]])
        return Brush(
            CalibratedCamera(camera.width, camera.height, vector, camera.covariance), self._rays
        )

    def plane(self, box: Box, height: float, samples: int) -> tuple[Canvas, Canvas]:
        """Return x, y (rows, columns) m of all sub-pixels in a box, on the plane at a height."""
        fine = cv2.resize(
            self._rays[box], None, fx=samples, fy=samples, interpolation=cv2.INTER_LINEAR
        )
        R = cv2.Rodrigues(self.camera.vector[:3])[0].astype(np.float32)
        centre = self.camera.centre.astype(np.float32)
        x, y, z = (fine[..., 0] * R[0, k] + fine[..., 1] * R[1, k] + R[2, k] for k in range(3))
        far = (np.float32(height) - centre[2]) / z
        return centre[0] + far * x, centre[1] + far * y

    def box(self, points: Array, margin: int = 2) -> Box | None:
        """Return the box around points (n, 3) m in map; None if they are outside the picture."""
        pixels = self.camera.project(points)
        low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - margin, 0)
        size = (self.camera.width, self.camera.height)
        high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, size)
        if (high <= low).any():
            return None
        return slice(low[1], high[1]), slice(low[0], high[0])

    def stamp(
        self, patch: Canvas, box: Box, height: float, paint: Paint, samples: int = SAMPLES
    ) -> None:
        """Paint a plane at a height into the patch of a box, in place."""
        colours = paint(*self.plane(box, height, samples))
        colours[..., :3] *= colours[..., 3:]
        size = patch.shape[1], patch.shape[0]
        mean = cv2.resize(colours, size, interpolation=cv2.INTER_AREA)
        patch *= 1.0 - mean[..., 3:]
        patch += mean[..., :3]

    def hull(self, patch: Any, box: Box, points: Array, colour: tuple[int, int, int]) -> None:
        """Paint a convex body with corners (n, 3) m into a patch, in place."""
        pixels = self.camera.project(points) - np.array([box[1].start, box[0].start])
        outline = cv2.convexHull((pixels * (1 << FRACTION_BITS)).round().astype(np.int32))
        cv2.fillPoly(patch, [outline], colour[::-1], lineType=cv2.LINE_8, shift=FRACTION_BITS)


def _rays(camera: CalibratedCamera) -> Canvas:
    """Return the direction (height, width, 2) of each pixel's ray in the camera's frame, at depth 1."""
    lens = camera.vector.copy()
    lens[EXTRINSIC] = 0.0
    rays = CalibratedCamera(camera.width, camera.height, lens, camera.covariance).rays(grid(camera))
    return rays[:, :2].reshape(camera.height, camera.width, 2).astype(np.float32)


def grid(camera: CalibratedCamera) -> Array:
    """Return all pixels of a camera, (height * width, 2)."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)


def around(centre: Array, radius: float, *heights: float) -> Array:
    """Return points (n, 3) m on circles at some heights."""
    angles = np.linspace(0.0, 2 * np.pi, 33)[:-1]
    ring = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for z in heights])


def disc(centre: Array, radius: float, colour: tuple[int, int, int]) -> Paint:
    """Return the paint of a disc: centre (2,) and radius in m in the painted plane, colour in RGB."""

    def paint(x: Canvas, y: Canvas) -> Canvas:
        inside = np.hypot(x - centre[0], y - centre[1]) <= radius
        return _flat(colour, inside)

    return paint


def card(image: Pixels, side: float, margin: float) -> Paint:
    """Return the paint of a grey picture, `side` m wide and centred at 0, on a white card."""
    rows, columns = image.shape
    cell = np.float32(side / columns)

    def paint(x: Canvas, y: Canvas) -> Canvas:
        column = np.floor(x / cell + 0.5 * columns).astype(np.int32)
        row = np.floor(0.5 * rows - y / cell).astype(np.int32)
        framed = np.pad(image, 1, constant_values=255)
        cells = framed[np.clip(row, -1, rows) + 1, np.clip(column, -1, columns) + 1]
        grey = 25.0 + np.float32(0.8) * cells
        on = (np.abs(x) <= 0.5 * side + margin) & (np.abs(y) <= 0.5 * rows * cell + margin)
        return np.stack([grey, grey, grey, on.astype(np.float32)], axis=-1)

    return paint


def placed(paint: Paint, pose: Array) -> Paint:
    """Return a paint moved to a pose (3,)."""
    x0, y0 = pose[:2].astype(np.float32)
    c, s = np.float32(np.cos(pose[2])), np.float32(np.sin(pose[2]))

    def moved(x: Canvas, y: Canvas) -> Canvas:
        dx, dy = x - x0, y - y0
        return paint(c * dx + s * dy, c * dy - s * dx)

    return moved


def _flat(colour: tuple[int, int, int], inside: npt.NDArray[np.bool_]) -> Canvas:
    blue_green_red = np.array(colour[::-1], np.float32)
    painted = np.broadcast_to(blue_green_red, (*inside.shape, 3))
    return np.concatenate([painted, inside[..., None].astype(np.float32)], axis=-1)
