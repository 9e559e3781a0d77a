"""A camera on the simulated robot, which shows the objects of the world on a tiled floor.

One ray per column hits the nearest wall and the nearest cylinder (`simulation.raycast.trace`); rows follow
from the pinhole model: a point h above the floor at depth z appears (h - h_camera) f / z above the horizon.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from impslam.simulation.paint import Pixels, paint
from impslam.simulation.raycast import trace
from impslam.simulation.scene import Scene, Thing
from impslam.types import Array

MAX_DISTANCE = 60.0  # m
HEIGHTS = {"cylinder": 0.7, "person": 0.8}  # m; a column shows one object of each layer
HEIGHT = 0.9  # m, of all straight objects: boards in a hall
# Red, green, blue. Neighbouring walls differ, so that a picture shows where the robot is looking.
WALLS = ((196, 176, 150), (150, 178, 190), (178, 190, 154), (192, 158, 158), (168, 160, 190))
COLOURS = {
    "cylinder": (232, 110, 40),
    "person": (60, 70, 110),
    "box": (170, 130, 80),
    "door": (140, 96, 60),
    "room": (120, 118, 112),
    "doorway": (110, 106, 100),
}


class Lens(NamedTuple):
    """Size of the picture and focal length, px, and the camera's position on the robot, m."""

    width: int = 640
    height: int = 240
    focal: float = 440.4  # 640 px across 72 deg; 240 px are then 30.5 deg
    above_floor: float = 0.35
    forward: float = 0.15


class SceneCamera:
    """The pictures of a camera on the robot.

    Parameters
    ----------
    scene : the world
    lens : the camera
    quality : JPEG quality, 1 to 100
    """

    def __init__(self, scene: Scene, lens: Lens | None = None, quality: int = 85) -> None:
        self._scene, self._lens, self._quality = scene, lens or Lens(), quality

    def picture(self, pose: Array, time: float) -> Pixels:
        """Return (height, width, 3) in OpenCV's order blue, green, red.

        Parameters
        ----------
        pose : (3,) `T_map_base`
        time : time in the world, s, which determines doors and people
        """
        lens = self._lens
        heading = float(pose[2])
        eye = np.array(pose, dtype=np.float64)
        eye[:2] += lens.forward * np.array([math.cos(heading), math.sin(heading)])
        image = np.empty((lens.height, lens.width, 3), np.uint8)
        straight, round_ = self._straight(eye, time), self._round(eye, time)
        paint(image, eye, lens.focal, lens.above_floor, straight, round_)
        return image

    def jpeg(self, pose: Array, time: float) -> bytes:
        """Return the picture as a JPEG file."""
        image = self.picture(pose, time)
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        return data.tobytes()

    @cached_property
    def _columns(self) -> Array:
        """Angle of each column's ray in the camera, (width,) rad, positive to the left."""
        middle = 0.5 * (self._lens.width - 1)
        side = middle - np.arange(self._lens.width, dtype=np.float64)
        return np.asarray(np.arctan(side / self._lens.focal), dtype=np.float64)

    @cached_property
    def _appearances(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Heights (k,) and colours (k, 3) of straight objects, and of round ones."""
        scene = self._scene
        segments, circles = len(scene.segments), len(scene.circles)
        leaves = len(scene.leaves(0.0))
        things = scene.things
        first, second = segments + circles, segments + circles + leaves
        straight = (*things[:segments], *things[first:second])
        return _appearance(straight), _appearance((*things[segments:first], *things[second:]))

    def _straight(self, eye: Array, time_: float) -> Array:
        segments = np.vstack([self._scene.segments, self._scene.leaves(time_)])
        depth, light, hits, points = self._cast(eye, segments, np.empty((0, 3)))
        chosen = segments[hits] if len(segments) else np.zeros((len(hits), 4))
        vectors = chosen[:, 2:] - chosen[:, :2]
        length = np.maximum(np.hypot(*vectors.T), np.finfo(float).tiny)
        along = ((points - chosen[:, :2]) * vectors).sum(1) / length
        return _layer(depth, along, light, self._appearances[0], hits)

    def _round(self, eye: Array, time_: float) -> Array:
        circles = np.vstack([self._scene.circles, self._scene.legs(time_)])
        depth, light, hits, _ = self._cast(eye, np.empty((0, 4)), circles)
        return _layer(depth, np.full(len(hits), -1.0), light, self._appearances[1], hits)

    def _cast(
        self, eye: Array, segments: Array, circles: Array
    ) -> tuple[Array, Array, npt.NDArray[np.int64], Array]:
        """Return depth (inf without a hit), light, index and point of the hit for each column."""
        rays, nothing = self._columns, (np.empty((2, 0, 4)), np.empty((2, 0, 3)))
        lasers = np.tile(eye, (len(rays), 1))
        fractions = np.zeros(len(rays))
        ranges, cosines, hits = trace(
            lasers, rays, fractions, (segments, circles), nothing, MAX_DISTANCE
        )
        near = np.where(hits >= 0, ranges, 0.0)
        directions = eye[2] + rays
        points = eye[:2] + near[:, None] * np.column_stack([np.cos(directions), np.sin(directions)])
        # Brightest at normal incidence, and darker with distance.
        light = (0.55 + 0.45 * cosines) / (1.0 + 0.06 * near)
        return ranges * np.cos(rays), light, hits, points


def _appearance(things: tuple[Thing, ...]) -> tuple[Array, Array]:
    heights = [HEIGHTS.get(thing.kind, HEIGHT) for thing in things]
    colours = [COLOURS.get(thing.kind, WALLS[thing.part % len(WALLS)]) for thing in things]
    return np.array(heights, dtype=np.float64), np.array(colours, dtype=np.float64).reshape(-1, 3)


def _layer(
    depth: Array,
    along: Array,
    light: Array,
    appearance: tuple[Array, Array],
    hits: npt.NDArray[np.int64],
) -> Array:
    """Return [depth, height, position along it, light, blue, green, red] of the columns, (n, 7)."""
    heights, colours = appearance
    if not len(heights):
        return np.full((len(depth), 7), np.inf)
    return np.column_stack([depth, heights[hits], along, light, colours[hits, ::-1]])
