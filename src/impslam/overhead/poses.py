"""The robot's pose from the four corners of its marker, and how sure it is.

Least squares over eight coordinates, with the marker flat at its height above the floor: a marker that
is 20 cm up appears where the line of sight meets the floor, decimetres further out. Unknown are the
pose and, since blur rounds corners and makes a marker look smaller, its scale; four degrees of freedom
are left and tell the noise of the corners. That noise differs from picture to picture; errors of the
calibration and of the marker's height do not, and are a part of each covariance that no averaging
removes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import rotation, transform
from impslam.overhead.camera import SIZE, Camera, project
from impslam.types import Array, Mask

ALIASING = 0.03  # px, error of an edge that follows a row of pixels, which residuals do not show
STEPS = 6  # of Gauss and Newton; from a start as near as this, three suffice
CORNERS = 0.5 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
"""Corners of a marker of size 1 in its own frame, in OpenCV's order: x right, y up."""
GATE = 25.5  # chi-square of 4 degrees of freedom, exceeded by chance in one picture of 25 000


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of the robot in pictures.

    Attributes
    ----------
    poses : (n, 3) `T_map_base`
    covariances : (n, 3, 3), of which `shared` (n, 3, 3) is common to all pictures
    good : (n,) which pictures fit a marker that lies flat at its height
    sigma : px, noise of a corner's coordinate, as the residuals tell it
    """

    poses: Array
    covariances: Array
    shared: Array
    good: Mask
    sigma: float

    def only(self, chosen: Mask) -> Poses:
        """Return those of some pictures (n,)."""
        return Poses(
            self.poses[chosen], self.covariances[chosen], self.shared[chosen], self.good[chosen], self.sigma
        )  # fmt: skip


def corners_in_base(size: float, mount: Array) -> Array:
    """Return the corners (4, 2) m of a marker at `T_base_marker` (3,) on the robot."""
    return transform(mount, size * CORNERS)


def find_poses(
    camera: Camera, pixels: Array, corners: Array, height: float, height_sigma: float
) -> Poses:
    """Return the poses in which corners (4, 2) m in base_link are seen at pixels (n, 4, 2)."""
    x = _start(camera, pixels, corners, height)
    for _ in range(STEPS):
        residuals = pixels.reshape(-1, 8) - _seen(camera.vector, x, corners, height)
        J = _by_unknowns(camera.vector, x, corners, height)
        gradient = J.transpose(0, 2, 1) @ residuals[..., None]
        x = x + np.linalg.solve(J.transpose(0, 2, 1) @ J, gradient)[..., 0]
    left = np.sum(residuals**2, axis=1)
    sigma = math.hypot(_noise(left), ALIASING)
    poses = np.column_stack([x[:, :2], wrap(x[:, 2])])
    noise, shared = covariances_at(camera, poses, corners, height, height_sigma, sigma)
    return Poses(poses, noise + shared, shared, left <= GATE * sigma**2, sigma)


def covariances_at(
    camera: Camera, poses: Array, corners: Array, height: float, height_sigma: float, sigma: float
) -> tuple[Array, Array]:
    """Return the covariances (n, 3, 3) of poses (n, 3) by noise of so many px, and by calibration."""
    x = np.column_stack([poses, np.ones(len(poses))])
    J = _by_unknowns(camera.vector, x, corners, height)
    inverse = np.linalg.inv(J.transpose(0, 2, 1) @ J)[:, :3]
    by_shared = inverse @ J.transpose(0, 2, 1) @ _by_shared(camera.vector, x, corners, height)
    spread = np.zeros((SIZE + 1, SIZE + 1))
    spread[:SIZE, :SIZE], spread[SIZE, SIZE] = camera.covariance, height_sigma**2
    return np.asarray(
        sigma**2 * inverse[:, :, :3], float
    ), by_shared @ spread @ by_shared.transpose(0, 2, 1)


def _noise(left: Array) -> float:
    """Return the noise of a corner's coordinate in px from sums of squared residuals (n,).

    Of four degrees of freedom each. The median of chi-square (4) is 3.357; a few pictures that show
    something else do not move it.
    """
    return math.sqrt(float(np.median(left)) / 3.3567) if len(left) else math.nan


def _start(camera: Camera, pixels: Array, corners: Array, height: float) -> Array:
    """Return poses and scales (n, 4) from the corners laid on the plane of the marker."""
    laid = camera.on_plane(pixels.reshape(-1, 2), height).reshape(-1, 4, 2)
    centred, wanted = corners - corners.mean(axis=0), laid - laid.mean(axis=1, keepdims=True)
    dot = np.sum(centred * wanted, axis=(1, 2))
    cross = np.sum(centred[:, 0] * wanted[..., 1] - centred[:, 1] * wanted[..., 0], axis=1)
    theta = np.arctan2(cross, dot)
    middle = np.einsum("nij,j->ni", _rotations(theta), corners.mean(axis=0))
    return np.column_stack([laid.mean(axis=1) - middle, theta, np.ones(len(theta))])


def _rotations(theta: Array) -> Array:
    return np.array([rotation(float(angle)) for angle in theta]).reshape(-1, 2, 2)


def _seen(vector: Array, x: Array, corners: Array, height: float) -> Array:
    """Return where corners at poses and scales (n, 4) are seen, (n, 8) px."""
    middle = corners.mean(axis=0)
    along, across = np.moveaxis(middle + x[:, 3, None, None] * (corners - middle), -1, 0)
    c, s = np.cos(x[:, 2, None]), np.sin(x[:, 2, None])
    there = x[:, 0, None] + c * along - s * across, x[:, 1, None] + s * along + c * across
    points = np.column_stack([*(part.ravel() for part in there), np.full(4 * len(x), height)])
    return project(vector, points).reshape(-1, 8)


def _by_unknowns(vector: Array, x: Array, corners: Array, height: float) -> Array:
    """Return the derivatives (n, 8, 4) of what is seen, by central differences."""
    step = 1e-5
    columns = []
    for delta in step * np.eye(4):
        ahead = _seen(vector, x + delta, corners, height)
        behind = _seen(vector, x - delta, corners, height)
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=-1)


def _by_shared(vector: Array, x: Array, corners: Array, height: float) -> Array:
    """Return the derivatives (n, 8, 16) by the camera's vector and the marker's height."""
    columns = []
    for k in range(SIZE):
        delta = np.zeros(SIZE)
        delta[k] = 1e-6 * max(1.0, abs(vector[k]))
        ahead = _seen(vector + delta, x, corners, height)
        behind = _seen(vector - delta, x, corners, height)
        columns.append((ahead - behind) / (2 * delta[k]))
    ahead, behind = (_seen(vector, x, corners, height + sign * 1e-5) for sign in (1, -1))
    return np.stack([*columns, (ahead - behind) / 2e-5], axis=-1)
