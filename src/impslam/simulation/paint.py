"""Paints the pictures of the virtual on-board camera, column by column."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel
from impslam.types import Array

Pixels = npt.NDArray[np.uint8]

STRIPE = 0.5  # m, width of the walls' stripes and of the floor's tiles


@kernel
def paint(
    image: Pixels, eye: Array, focal: float, above_floor: float, first: Array, second: Array
) -> None:
    """Paint each column: background, floor, then both layers (n, 7), the nearer over the farther."""
    c, s = math.cos(eye[2]), math.sin(eye[2])
    for column in range(image.shape[1]):
        side = (0.5 * (image.shape[1] - 1) - column) / focal
        strip = image[:, column]
        _background(strip, focal)
        _floor(strip, focal, above_floor, eye, c - side * s, s + side * c)
        near, far = first[column], second[column]
        if far[0] < near[0]:
            near, far = far, near
        _upright(strip, focal, above_floor, far)
        _upright(strip, focal, above_floor, near)


@kernel
def _background(strip: Pixels, focal: float) -> None:
    """Paint the background, with a vertical gradient."""
    rows = len(strip)
    for row in range(rows):
        slope = (0.5 * (rows - 1) - row) / focal
        strip[row, 0] = int(140 - 220 * slope)
        strip[row, 1] = int(132 - 220 * slope)
        strip[row, 2] = int(124 - 220 * slope)


@kernel
def _floor(
    strip: Pixels, focal: float, above_floor: float, eye: Array, dx: float, dy: float
) -> None:
    """Paint tiles that are fixed in the world; (dx, dy) is the displacement on the floor per depth."""
    rows = len(strip)
    for row in range((rows + 1) // 2, rows):
        z = above_floor * focal / (row - 0.5 * (rows - 1))
        tile = math.floor((eye[0] + z * dx) / STRIPE) + math.floor((eye[1] + z * dy) / STRIPE)
        grey = (104.0 if tile % 2 == 0 else 128.0) / (1.0 + 0.06 * z)
        strip[row, 0] = int(grey * 0.96)
        strip[row, 1] = int(grey)
        strip[row, 2] = int(grey * 1.02)


@kernel
def _upright(strip: Pixels, focal: float, above_floor: float, thing: Array) -> None:
    """Paint the object in a column: [depth, height, along, light, blue, green, red]."""
    depth, height, along, light = thing[0], thing[1], thing[2], thing[3]
    if not depth < math.inf:
        return
    middle, scale = 0.5 * (len(strip) - 1), focal / max(depth, 0.01)
    top = max(math.ceil(middle - (height - above_floor) * scale), 0)
    bottom = min(math.floor(middle + above_floor * scale), len(strip) - 1)
    if along >= 0.0 and math.floor(along / STRIPE) % 2 == 1:
        light *= 0.86
    for row in range(top, bottom + 1):
        h = above_floor + (middle - row) / scale
        shade = light
        if along < 0.0 and 0.4 < h / height < 0.6:
            shade *= 1.35  # the band of a cone
        elif h < 0.05 or h > height - 0.03:
            shade *= 0.6  # skirting and edge
        for k in range(3):
            strip[row, k] = int(min(thing[4 + k] * shade, 255.0))
