"""Corners of a marker as the intersections of its four edges.

OpenCV refines corners in a small window each, and cells next to the corner bias it by a tenth of a pixel.
An edge provides as many measurements as pixels: the grey profile across it is black inside and white
outside, and the centroid of its slope is the position of the edge (Tabatabai & Mitchell 1984), for any
symmetric blur.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from impslam.types import Array, Mask

END_MARGIN = 0.12  # share of an edge that is left out at either end: blur of the corner
HALF_WIDTH = 0.4
"""of a profile, in cells: blur of the cells within the black border must not matter."""
STEP = 0.25  # px between samples of a profile
ROUNDS = 4  # in which the window follows the edge
MIN_CONTRAST = 20.0  # grey levels; edges of markers have more


def refine(grey: Any, corners: Array, cells: int) -> Array | None:
    """Return the refined corners (4, 2) px of a marker that is `cells` wide, or None.

    `grey` is the picture, float32; `corners` are clockwise and accurate to about a pixel. Return None if an
    edge has too little contrast, or the edges do not intersect near the corners.
    """
    found = corners.astype(np.float64)
    for _ in range(ROUNDS):
        lines = _lines(grey, found, cells)
        if lines is None:
            return None
        found = _intersections(*lines)
    size = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).mean()
    near = np.abs(found - corners).max() <= max(2.0, HALF_WIDTH * size / cells)
    return found if near else None


def _lines(grey: Any, corners: Array, cells: int) -> tuple[Array, Array] | None:
    """Return a point (4, 2) px on each edge and its direction (4, 2)."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    outward = np.column_stack([sides[:, 1], -sides[:, 0]]) / lengths[:, None]
    number = max(int(lengths.mean()), 6)
    half = HALF_WIDTH * float(lengths.mean()) / cells
    along = np.linspace(END_MARGIN, 1.0 - END_MARGIN, number)
    across = np.linspace(-half, half, 2 * max(int(half / STEP), 4) + 1)
    feet = corners[:, None] + along[:, None] * sides[:, None]
    samples = (feet[:, :, None] + across[:, None] * outward[:, None, None]).astype(np.float32)
    flat = samples.reshape(4 * number, len(across), 2)
    profile = cv2.remap(grey, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR).reshape(4, number, -1)
    slope = np.diff(profile, axis=-1)
    rise = slope.sum(axis=-1)
    if not _is_edge(rise):
        return None
    offset = (slope @ (0.5 * (across[1:] + across[:-1]))) / rise
    design = np.column_stack([np.ones(number), along])
    begin, tilt = np.linalg.lstsq(design, offset.T, rcond=None)[0]
    return corners + begin[:, None] * outward, sides + tilt[:, None] * outward


def _is_edge(rise: Array) -> bool:
    bright: Mask = rise > 0.5 * np.median(rise)
    return bool(np.median(rise) > MIN_CONTRAST and bright.all())


def _intersections(points: Array, directions: Array) -> Array:
    """Return the intersection (4, 2) of each line with the previous one."""
    start, along = np.roll(points, 1, axis=0), np.roll(directions, 1, axis=0)
    cross = along[:, 0] * directions[:, 1] - along[:, 1] * directions[:, 0]
    gap = points - start
    far = (gap[:, 0] * directions[:, 1] - gap[:, 1] * directions[:, 0]) / cross
    return np.asarray(start + far[:, None] * along)
