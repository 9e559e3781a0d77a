"""An overhead camera over a simulated world: pictures with distortion, blur and noise."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np

from impslam.errors import ConfigError
from impslam.overhead.camera import SIZE, CalibratedCamera
from impslam.overhead.setup import Marker, dictionary
from impslam.simulation.camera import WALLS
from impslam.simulation.drive import Path
from impslam.simulation.overhead_paint import (
    Box,
    Brush,
    Canvas,
    Paint,
    Pixels,
    around,
    card,
    disc,
    grid,
    placed,
)  # fmt: skip
from impslam.simulation.robot import OverheadCamera
from impslam.simulation.scene import Scene
from impslam.types import Array

ORANGE, BODY, WOOD, CLOTH = (232, 110, 40), (60, 64, 70), (170, 150, 120), (60, 70, 110)
WALL_HEIGHT, CYLINDER_HEIGHT, PERSON_HEIGHT = 0.6, 0.4, 1.75  # m
SHOULDERS = 0.22  # m, radius of a person from above
TILE = 0.5  # m, of the floor
SHEET = 0.45  # m, radius of the sheet over the robot while it is hidden
CARD = 0.25  # white margin of a marker, as a share of its size: two cells
FLOOR_SIZE = 2.0  # size of the floor's markers, relative to the robot's
FLOOR_IDS = range(10, 18)
MIN_MARKER_PIXELS = 16.0  # px; smaller markers are not read reliably
EXPOSURES = 3  # times that are averaged for an exposure
BORDER = 8  # px around the robot, more than its blur
NOISE_TILE = 64  # px, maximum shift of the noise between pictures


def camera_above(device: OverheadCamera, scene: Scene) -> CalibratedCamera:
    """Return the camera above the centre of a world, its width along the longer side.

    Raises
    ------
    ConfigError
        If it does not see the whole path, or the marker appears too small.
    """
    plan = scene.world.robot
    path = np.vstack([plan.start[:2], plan.waypoints])
    corners = np.vstack([path, scene.segments.reshape(-1, 2)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    along = np.array([1.0, 0, 0]) if np.argmax(high - low) == 0 else np.array([0, 1.0, 0])
    down = np.array([0.0, 0.0, -1.0])
    plumb = np.stack([along, np.cross(down, along), down])
    tilted = cv2.Rodrigues(np.array([*device.tilt, 0.0]))[0] @ plumb
    centre = np.array([*(0.5 * (low + high)), device.above])
    vector = np.zeros(SIZE)
    vector[:3], vector[3:6] = cv2.Rodrigues(tilted)[0].ravel(), -tilted @ centre
    vector[6:8] = device.focal
    vector[8:10] = 0.5 * (device.width - 1), 0.5 * (device.height - 1)
    vector[10:14] = device.distortion
    camera = CalibratedCamera(device.width, device.height, vector, np.zeros((SIZE, SIZE)))
    _check(device, camera, np.column_stack([path, np.full(len(path), device.marker_height)]))
    return camera


def _check(device: OverheadCamera, camera: CalibratedCamera, path: Array) -> None:
    if not camera.sees(camera.project(path)).all():
        raise ConfigError(
            f"overhead.above = {device.above:g}: the camera does not see the whole path; increase it, "
            "or reduce overhead.focal"
        )
    width = device.focal * device.marker_size / (device.above - device.marker_height)
    if width < MIN_MARKER_PIXELS:
        raise ConfigError(
            f"overhead.marker_size = {device.marker_size:g}: is {width:.0f} px wide from "
            f"{device.above:g} m, and must be {MIN_MARKER_PIXELS:.0f}; make it "
            f"{device.marker_size * MIN_MARKER_PIXELS / width:.2f} m"
        )


class Film:
    """The pictures of a run."""

    def __init__(
        self, device: OverheadCamera, scene: Scene, path: Path, rng: np.random.Generator
    ) -> None:
        self._device, self._scene, self._path, self._rng = device, scene, path, rng
        self.camera = camera_above(device, scene)
        self._brush = Brush(self.camera)
        self._whole = slice(0, device.height), slice(0, device.width)
        self._sharp = self._background()
        self._still = self._blurred(self._sharp)

    def picture(self, time: float) -> Pixels:
        """Return the picture (height, width, 3), blue, green, red, with its exposure centred at a time."""
        image = self._still.copy()
        pose = self._path.at(np.array([time]))[0]
        box = self._brush.box(self._body(pose), margin=BORDER)
        if box is not None:
            half = 0.5 * self._device.exposure
            times = np.clip(np.linspace(time - half, time + half, EXPOSURES), 0.0, None)
            patches = [self._robot(moved, box) for moved in self._path.at(times)]
            image[box] = self._blurred(np.mean(patches, axis=0, dtype=np.float32))
        self._cover(image, pose, time)
        return self._noisy(image)

    def _robot(self, pose: Array, box: Box) -> Canvas:
        """Return the sharp scene in a box with the robot, a plate with a marker, at a pose (3,)."""
        patch, height = self._sharp[box].copy(), self._device.marker_height
        self._brush.hull(patch, box, self._body(pose), BODY)
        middle = self._brush.box(around(pose[:2], self._device.marker_size, height))
        if middle is not None:
            rows, columns = (
                slice(part.start - all_.start, part.stop - all_.start)
                for part, all_ in zip(middle, box, strict=True)
            )
            self._brush.stamp(patch[rows, columns], middle, height, placed(self._card, pose))
        hiding = self._hiding[box][..., None] > 0
        return np.where(hiding, self._sharp[box], patch)

    def _body(self, pose: Array) -> Array:
        """Return the outline (n, 3) m of the robot at a pose; its plate is as large as the card."""
        radius = max(self._scene.world.robot.radius, self._device.marker_size)
        return around(pose[:2], radius, 0.0, self._device.marker_height)

    def _cover(self, image: Pixels, pose: Array, time: float) -> None:
        """Paint moving objects that are higher than the robot, in place."""
        for begin, end in self._device.hidden:
            if begin <= time <= end:
                sheet = around(pose[:2], SHEET, self._device.marker_height + 0.1)
                self._brush.hull(image, self._whole, sheet, CLOTH)
        for leaf in self._scene.leaves(time):
            self._brush.hull(image, self._whole, _upright(leaf, 0.0), WOOD)
        legs = self._scene.legs(time)
        for left, right in zip(legs[::2], legs[1::2], strict=True):
            body = around(0.5 * (left + right)[:2], SHOULDERS, 0.9, PERSON_HEIGHT)
            feet = np.vstack([around(leg[:2], leg[2], 0.0) for leg in (left, right)])
            self._brush.hull(image, self._whole, np.vstack([body, feet]), CLOTH)

    @cached_property
    def _card(self) -> Paint:
        """The marker on a white card."""
        side = self._device.marker_size
        return card(marker_cells(Marker().id), side, CARD * side)

    def _background(self) -> Canvas:
        """Return the static scene without blur."""
        canvas = self._floor()
        for point, number in zip(floor_points(self.camera), FLOOR_IDS, strict=True):
            side = FLOOR_SIZE * self._device.marker_size
            white = card(marker_cells(number), side, CARD * side)
            box = self._brush.box(around(point, side, 0.0))
            if box is not None:
                self._brush.stamp(canvas[box], box, 0.0, placed(white, np.array([*point, 0.0])))
        for thing, wall in zip(self._scene.things, self._scene.segments, strict=False):
            colour = WALLS[thing.part % len(WALLS)] if thing.kind == "wall" else WOOD
            self._brush.hull(canvas, self._whole, _upright(wall, 0.0), colour)
        for x, y, radius in self._scene.circles:
            centre = np.array([x, y])
            body = around(centre, radius, 0.0, CYLINDER_HEIGHT)
            self._brush.hull(canvas, self._whole, body, BODY)
            box = self._brush.box(around(centre, radius, CYLINDER_HEIGHT))
            if box is not None:
                top = disc(centre, radius, ORANGE)
                self._brush.stamp(canvas[box], box, CYLINDER_HEIGHT, top)
        return canvas

    def _floor(self) -> Canvas:
        """Return a tiled floor with some grain."""
        laid = self.camera.on_plane(grid(self.camera), 0.0)
        tiles = np.floor(laid / TILE).sum(axis=1) % 2
        grain = np.random.default_rng(0).standard_normal(len(tiles))
        grey = (120.0 + 14.0 * tiles + 3.0 * grain).reshape(self.camera.height, -1)
        return np.stack([grey, grey, grey], axis=-1).astype(np.float32)

    @cached_property
    def _hiding(self) -> Pixels:
        """Mask (height, width) of objects between the camera and the marker's height."""
        mask = np.zeros((self._device.height, self._device.width), np.uint8)
        low = self._device.marker_height
        for wall in self._scene.segments:
            self._brush.hull(mask, self._whole, _upright(wall, low), (255, 255, 255))
        for x, y, radius in self._scene.circles:
            body = around(np.array([x, y]), radius, low, CYLINDER_HEIGHT)
            self._brush.hull(mask, self._whole, body, (255, 255, 255))
        return mask

    def _blurred(self, canvas: Canvas) -> Pixels:
        return blurred(canvas, self._device.blur)

    def _noisy(self, image: Pixels) -> Pixels:
        dy, dx = self._rng.integers(0, NOISE_TILE, 2)
        grain = self._grain[dy : dy + image.shape[0], dx : dx + image.shape[1]]
        return np.asarray(cv2.add(image, grain, dtype=cv2.CV_8U))

    @cached_property
    def _grain(self) -> Any:
        """Noise for a picture and a margin, from which each picture takes a part, as drawing is slow."""
        size = (self._device.height + NOISE_TILE, self._device.width + NOISE_TILE, 3)
        noise = self._rng.standard_normal(size, np.float32)
        return np.rint(self._device.noise * noise).astype(np.int16)


def blurred(canvas: Canvas, sigma: float) -> Pixels:
    """Return the picture of a canvas through a lens with a blur, px."""
    soft = cv2.GaussianBlur(canvas, (0, 0), sigma) if sigma > 0.0 else canvas
    return np.clip(np.rint(soft), 0, 255).astype(np.uint8)


def floor_points(camera: CalibratedCamera) -> Array:
    """Return the positions of the floor's markers, (8, 2) m, along the borders of the picture."""
    share = np.array(
        [[0.08, 0.12], [0.5, 0.08], [0.92, 0.12], [0.95, 0.5], [0.92, 0.88], [0.5, 0.92], [0.08, 0.88],
         [0.05, 0.5]]
    )  # fmt: skip
    return camera.on_plane(share * np.array([camera.width, camera.height]), 0.0)


def marker_cells(number: int) -> Pixels:
    """Return a marker of the robot's dictionary, one pixel per cell."""
    kind = dictionary(Marker().dictionary)
    return np.asarray(cv2.aruco.generateImageMarker(kind, number, kind.markerSize + 2))


def _upright(ends: Array, low: float) -> Array:
    """Return the corners (4, 3) m of a wall with ends (4,), above a height."""
    x1, y1, x2, y2 = ends
    return np.array([[x1, y1, low], [x2, y2, low], [x2, y2, WALL_HEIGHT], [x1, y1, WALL_HEIGHT]])
