"""Locate coloured discs on cylinders, for the truth of a map.

The colour is segmented in Lab, where light and shade affect only L. The outline is projected to the plane
of the disc, and a circle is fitted to it; circles without the radius of a disc are rejected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from impslam.overhead.camera import SIZE, CalibratedCamera
from impslam.overhead.setup import Discs
from impslam.types import Array

RADIUS_TOLERANCE = 0.15  # share of the radius
MAX_SCATTER = 0.06  # share of the radius, of an outline about its circle
MIN_AREA = 40  # px
OUTLINE_SIGMA = 0.1  # px, error of a disc's middle due to light and shade at its rim


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredCylinder:
    """A cylinder as the camera measured it: centre (2,) m in map, its covariance, radius in m."""

    centre: Array
    covariance: Array
    radius: float


def find_cylinders(still: Any, camera: CalibratedCamera, discs: Discs) -> list[MeasuredCylinder]:
    """Return the cylinders in a picture of the static scene, sorted by their x in map."""
    mask = _coloured(still, discs)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = []
    for outline in outlines:
        if cv2.contourArea(outline) < MIN_AREA:
            continue
        cylinder = _fit(outline.reshape(-1, 2).astype(np.float64), camera, discs)
        if cylinder is not None:
            found.append(cylinder)
    return sorted(found, key=lambda cylinder: tuple(cylinder.centre))


def _coloured(picture: Any, discs: Discs) -> Any:
    """Return a mask of the discs' colour: 255 there, else 0."""
    rgb = [int(discs.colour[k : k + 2], 16) for k in (1, 3, 5)]
    wanted = _lab(np.array([[rgb[::-1]]], np.uint8))[0, 0, 1:]
    distance = np.linalg.norm(_lab(picture)[..., 1:] - wanted, axis=-1)
    return np.where(distance <= discs.tolerance, 255, 0).astype(np.uint8)


def _lab(picture: Any) -> Array:
    return np.asarray(cv2.cvtColor(picture.astype(np.float32) / 255.0, cv2.COLOR_BGR2LAB))


def _fit(outline: Array, camera: CalibratedCamera, discs: Discs) -> MeasuredCylinder | None:
    """Fit a disc to an outline (n, 2) px; return None if it is not a disc."""
    points = camera.on_plane(outline, discs.height)
    centre, radius = _circle(points)
    scatter = np.linalg.norm(points - centre, axis=1) - radius
    # The outline passes through the middles of the outermost pixels.
    step = camera.on_plane(np.vstack([outline[0], outline[0] + [1, 0]]), discs.height)
    pixel = float(np.linalg.norm(step[1] - step[0]))
    radius += 0.5 * pixel
    nearest = min(discs.radii, key=lambda known: abs(known - radius))
    if (
        abs(radius / nearest - 1.0) > RADIUS_TOLERANCE
        or scatter.std() > MAX_SCATTER * nearest + pixel
    ):
        return None
    seen = camera.project(np.array([[*centre, discs.height]]))
    return MeasuredCylinder(centre, _covariance(camera, seen, discs.height, pixel), radius)


def _circle(points: Array) -> tuple[Array, float]:
    """Return centre (2,) and radius of the circle through points (n, 2), algebraic (Kasa 1976).

    The fit is exact for a complete outline.
    """
    design = np.column_stack([points, np.ones(len(points))])
    a, b, c = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    centre = 0.5 * np.array([a, b])
    return centre, float(np.sqrt(c + centre @ centre))


def _covariance(camera: CalibratedCamera, seen: Array, height: float, pixel: float) -> Array:
    """Return the covariance (2, 2) of the point that projects to a pixel (1, 2)."""
    columns = []
    for k in range(SIZE):
        delta = np.zeros(SIZE)
        delta[k] = 1e-6 * max(1.0, abs(camera.vector[k]))
        ahead, behind = (
            CalibratedCamera(
                camera.width, camera.height, camera.vector + sign * delta, camera.covariance
            )
            for sign in (1, -1)
        )
        change = ahead.on_plane(seen, height) - behind.on_plane(seen, height)
        columns.append(change[0] / (2 * delta[k]))
    by_camera = np.stack(columns, axis=-1)
    covariance: Array = by_camera @ camera.covariance @ by_camera.T
    return covariance + (OUTLINE_SIGMA * pixel) ** 2 * np.eye(2)
