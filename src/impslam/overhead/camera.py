"""Model of a fixed camera above the floor, with its covariance.

Pinhole with the distortion of Brown (1971), k1, k2, p1, p2, k3, as in OpenCV. All uncertain parameters are
in one vector, so that their covariance propagates to every pose:

    [rotation vector (3), translation (3) m of T_camera_map, fx, fy, cx, cy px, k1, k2, p1, p2, k3]

This is the order of the derivatives of `cv2.projectPoints`. The centre of the first pixel is 0, 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from impslam.types import Array

EXTRINSIC, LENS = slice(0, 6), slice(6, 15)
SIZE = 15


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """A calibrated camera.

    Attributes
    ----------
    width, height : px
    vector, covariance : (15,) and (15, 15), see the module
    """

    width: int
    height: int
    vector: Array
    covariance: Array

    @property
    def centre(self) -> Array:
        """Position of the lens in map, (3,) m."""
        rotation = cv2.Rodrigues(self.vector[:3])[0]
        return np.asarray(-rotation.T @ self.vector[3:6])

    def project(self, points: Array) -> Array:
        """Return the projections (n, 2) px of points (n, 3) m in map."""
        return project(self.vector, points)

    def rays(self, pixels: Array) -> Array:
        """Return the viewing directions (n, 3) of pixels (n, 2) in map, not normalised."""
        matrix, distortion = _lens(self.vector)
        flat = cv2.undistortPoints(
            pixels.reshape(-1, 1, 2), matrix, distortion, criteria=_EXACT
        ).reshape(-1, 2)
        rotation = cv2.Rodrigues(self.vector[:3])[0]
        return np.asarray(np.column_stack([flat, np.ones(len(flat))]) @ rotation)

    def on_plane(self, pixels: Array, height: float) -> Array:
        """Return the points (n, 2) m at a height above the floor that project to pixels (n, 2)."""
        rays, centre = self.rays(pixels), self.centre
        return np.asarray(centre[:2] + rays[:, :2] * ((height - centre[2]) / rays[:, 2:]))

    def sees(self, pixels: Array) -> Array:
        """Return (n,) whether pixels (n, 2) are in the picture."""
        inside = (pixels > -0.5) & (pixels < np.array([self.width, self.height]) - 0.5)
        return np.asarray(inside.all(axis=1))


_EXACT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)


def _lens(vector: Array) -> tuple[Array, Array]:
    fx, fy, cx, cy = vector[6:10]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), vector[10:15]


def project(vector: Array, points: Array) -> Array:
    """Return the projections (n, 2) px of points (n, 3) m in map, for a camera vector (15,)."""
    matrix, distortion = _lens(vector)
    pixels = cv2.projectPoints(points, vector[:3], vector[3:6], matrix, distortion)[0]
    return np.asarray(pixels.reshape(-1, 2))


def linearised(vector: Array, points: Array) -> tuple[Array, Array]:
    """Return projections (n, 2) px and their derivatives by the vector (2 n, 15)."""
    matrix, distortion = _lens(vector)
    pixels, jacobian = cv2.projectPoints(points, vector[:3], vector[3:6], matrix, distortion)
    return np.asarray(pixels.reshape(-1, 2), float), np.asarray(jacobian[:, :SIZE], float)
