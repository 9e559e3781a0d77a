"""Robot poses from the four corners of a marker, with covariances.

Least squares over eight coordinates, with the marker level at its height above the floor: without the
height, a marker 20 cm up would appear decimetres further out. The unknowns are the pose and a scale,
because blur rounds corners and makes a marker look smaller; the remaining four degrees of freedom give the
noise of the corners. That noise differs between pictures. Errors of the calibration and of the marker's
height do not: they are a common part of all covariances that averaging does not reduce.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import rotation, transform
from impslam.overhead.camera import SIZE, CalibratedCamera, project
from impslam.types import Array, Mask

ALIASING = 0.03  # px, error of an edge along a row of pixels, which is not visible in the residuals
STEPS = 6  # of Gauss-Newton; from such a close start, three suffice
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
    good : (n,) which pictures fit a level marker at its height
    sigma : px, noise of a corner's coordinate, estimated from the residuals
    """

    poses: Array
    covariances: Array
    shared: Array
    good: Mask
    sigma: float

    def only(self, chosen: Mask) -> Poses:
        """Return the poses of some pictures (n,)."""
        return Poses(
            self.poses[chosen], self.covariances[chosen], self.shared[chosen], self.good[chosen], self.sigma
        )  # fmt: skip


def corners_in_base(size: float, mount: Array) -> Array:
    """Return the corners (4, 2) m of a marker at `T_base_marker` (3,) on the robot."""
    return transform(mount, size * CORNERS)


def find_poses(
    camera: CalibratedCamera, pixels: Array, corners: Array, height: float, height_sigma: float
) -> Poses:
    """Return the poses for which corners (4, 2) m in base_link project to pixels (n, 4, 2)."""
    x = _start(camera, pixels, corners, height)
    for _ in range(STEPS):
        residuals = pixels.reshape(-1, 8) - _project_corners(camera.vector, x, corners, height)
        J = _by_unknowns(camera.vector, x, corners, height)
        gradient = J.transpose(0, 2, 1) @ residuals[..., None]
        x = x + np.linalg.solve(J.transpose(0, 2, 1) @ J, gradient)[..., 0]
    squares = np.sum(residuals**2, axis=1)
    sigma = math.hypot(_noise(squares), ALIASING)
    poses = np.column_stack([x[:, :2], wrap(x[:, 2])])
    noise, shared = covariances_at(camera, poses, corners, height, height_sigma, sigma)
    return Poses(poses, noise + shared, shared, squares <= GATE * sigma**2, sigma)


def covariances_at(
    camera: CalibratedCamera,
    poses: Array,
    corners: Array,
    height: float,
    height_sigma: float,
    sigma: float,
) -> tuple[Array, Array]:
    """Return the covariances (n, 3, 3) of poses (n, 3) due to noise of `sigma` px, and to calibration."""
    x = np.column_stack([poses, np.ones(len(poses))])
    J = _by_unknowns(camera.vector, x, corners, height)
    inverse = np.linalg.inv(J.transpose(0, 2, 1) @ J)[:, :3]
    by_shared = inverse @ J.transpose(0, 2, 1) @ _by_shared(camera.vector, x, corners, height)
    P = np.zeros((SIZE + 1, SIZE + 1))
    P[:SIZE, :SIZE], P[SIZE, SIZE] = camera.covariance, height_sigma**2
    noise = np.asarray(sigma**2 * inverse[:, :, :3], float)
    return noise, by_shared @ P @ by_shared.transpose(0, 2, 1)


def _noise(squares: Array) -> float:
    """Return the noise of a corner's coordinate in px from sums of squared residuals (n,).

    Each has four degrees of freedom. The median of chi-square (4) is 3.357; it is robust against a few
    pictures of something else.
    """
    return math.sqrt(float(np.median(squares)) / 3.3567) if len(squares) else math.nan


def _start(camera: CalibratedCamera, pixels: Array, corners: Array, height: float) -> Array:
    """Return poses and scales (n, 4) from the corners projected to the plane of the marker."""
    points = camera.on_plane(pixels.reshape(-1, 2), height).reshape(-1, 4, 2)
    centred, wanted = corners - corners.mean(axis=0), points - points.mean(axis=1, keepdims=True)
    dot = np.sum(centred * wanted, axis=(1, 2))
    cross = np.sum(centred[:, 0] * wanted[..., 1] - centred[:, 1] * wanted[..., 0], axis=1)
    theta = np.arctan2(cross, dot)
    middle = np.einsum("nij,j->ni", rotation(theta), corners.mean(axis=0))
    return np.column_stack([points.mean(axis=1) - middle, theta, np.ones(len(theta))])


def _project_corners(vector: Array, x: Array, corners: Array, height: float) -> Array:
    """Return the projections (n, 8) px of corners at poses and scales (n, 4)."""
    middle = corners.mean(axis=0)
    along, across = np.moveaxis(middle + x[:, 3, None, None] * (corners - middle), -1, 0)
    c, s = np.cos(x[:, 2, None]), np.sin(x[:, 2, None])
    in_map = x[:, 0, None] + c * along - s * across, x[:, 1, None] + s * along + c * across
    points = np.column_stack([*(part.ravel() for part in in_map), np.full(4 * len(x), height)])
    return project(vector, points).reshape(-1, 8)


def _by_unknowns(vector: Array, x: Array, corners: Array, height: float) -> Array:
    """Return the derivatives (n, 8, 4) of the projections by `x`, by central differences."""
    step = 1e-5
    columns = []
    for delta in step * np.eye(4):
        ahead = _project_corners(vector, x + delta, corners, height)
        behind = _project_corners(vector, x - delta, corners, height)
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=-1)


def _by_shared(vector: Array, x: Array, corners: Array, height: float) -> Array:
    """Return the derivatives (n, 8, 16) of the projections by camera vector and marker height."""
    columns = []
    for k in range(SIZE):
        delta = np.zeros(SIZE)
        delta[k] = 1e-6 * max(1.0, abs(vector[k]))
        ahead = _project_corners(vector + delta, x, corners, height)
        behind = _project_corners(vector - delta, x, corners, height)
        columns.append((ahead - behind) / (2 * delta[k]))
    ahead, behind = (_project_corners(vector, x, corners, height + sign * 1e-5) for sign in (1, -1))
    return np.stack([*columns, (ahead - behind) / 2e-5], axis=-1)
