"""Corners of a marker as the intersections of its four edges.

OpenCV refines corners in a small window each, where the cells next to the corner pull it aside by a
tenth of a pixel. Along an edge there are as many measurements as pixels: the grey profile across it is
black inside and white outside, and the centroid of its slope is where the edge is (Tabatabai &
Mitchell 1984), whatever the blur, as long as it is symmetric.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from impslam.types import Array, Mask

ENDS = 0.12  # of an edge that are left out at either end: the corner's blur
REACH = (
    0.4  # of a cell on either side: the cells within the black border must not be reached by blur
)
STEP = 0.25  # px between samples of a profile
ROUNDS = 4  # in which the window follows the edge
CONTRAST = 20.0  # grey levels; fainter edges are no marker's


def refine(grey: Any, corners: Array, cells: int) -> Array | None:
    """Return the corners (4, 2) px of a marker that is so many cells wide, or None.

    `grey` is the picture, float32; `corners` go clockwise, and lie within a pixel or so. None where an
    edge has too little contrast, or the edges do not meet near the corners.
    """
    found = corners.astype(np.float64)
    for _ in range(ROUNDS):
        lines = _lines(grey, found, cells)
        if lines is None:
            return None
        found = _meet(*lines)
    size = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).mean()
    near = np.abs(found - corners).max() <= max(2.0, REACH * size / cells)
    return found if near else None


def _lines(grey: Any, corners: Array, cells: int) -> tuple[Array, Array] | None:
    """Return a point (4, 2) px on each edge and its direction (4, 2)."""
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    outward = np.column_stack([sides[:, 1], -sides[:, 0]]) / lengths[:, None]
    number = max(int(lengths.mean()), 6)
    reach = REACH * float(lengths.mean()) / cells
    along = np.linspace(ENDS, 1.0 - ENDS, number)
    across = np.linspace(-reach, reach, 2 * max(int(reach / STEP), 4) + 1)
    feet = corners[:, None] + along[:, None] * sides[:, None]
    places = (feet[:, :, None] + across[:, None] * outward[:, None, None]).astype(np.float32)
    flat = places.reshape(4 * number, len(across), 2)
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
    return bool(np.median(rise) > CONTRAST and bright.all())


def _meet(points: Array, directions: Array) -> Array:
    """Return where each line meets the one before it, (4, 2)."""
    before, way = np.roll(points, 1, axis=0), np.roll(directions, 1, axis=0)
    cross = way[:, 0] * directions[:, 1] - way[:, 1] * directions[:, 0]
    gap = points - before
    far = (gap[:, 0] * directions[:, 1] - gap[:, 1] * directions[:, 0]) / cross
    return np.asarray(before + far[:, None] * way)
