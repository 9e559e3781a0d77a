"""Calibration of lens and camera pose from a board and measured points, by weighted least squares.

Views of a board determine the lens, measured points determine the camera's pose. Both are weighted by
their noise, together with a prior of typical cameras; the covariance is the inverse of the information
(Triggs et al. 2000). Without a board, only the points and the prior determine the lens, and the
covariances of all poses include its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from impslam.errors import ImpError
from impslam.geometry.chi_square import quantile
from impslam.overhead.camera import EXTRINSIC, LENS, CalibratedCamera, linearised, project
from impslam.types import Array

INITIAL_SIGMA = 0.3  # px, of a board's corner, before it is estimated from the residuals
ROUNDS = 3  # until the estimate of the corners' noise has converged
MIN_WIDTH_RATIO = 0.05  # of width to length of the points' extent: less does not determine a pose
MIN_POINTS = 4  # of a plane that determine a pose
FIT_PROBABILITY = 0.9999  # with which correct measurements of the points fit


class BoardView(NamedTuple):
    """Points (n, 3) m, in the board's frame or in map, and their pixels (n, 2)."""

    points: Array
    pixels: Array


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A calibrated camera with its residuals.

    Attributes
    ----------
    camera : the camera, with the covariance of its parameters
    board_rms, ground_rms : px, residuals per coordinate; NaN without a board
    views : number of views of the board
    odd_point : the measured point (3,) m that deviates most, if the points do not fit within their noise
    """

    camera: CalibratedCamera
    board_rms: float
    ground_rms: float
    views: int
    odd_point: Array | None


def calibrate(
    size: tuple[int, int],
    boards: Sequence[BoardView],
    ground: BoardView,
    sigma: float,
    pixel_sigma: Array,
) -> CameraCalibration:
    """Return the camera that fits views of a board and measured points best.

    Parameters
    ----------
    size : width and height of the picture, px
    sigma : m, standard deviation of a coordinate of a measured point
    pixel_sigma : (n,) px, standard deviations of the pixels of these points

    Raises
    ------
    ImpError
        If the points do not determine the camera's pose.
    """
    if len(ground.points) < MIN_POINTS:
        raise ImpError(
            f"{len(ground.points)} measured points on the floor; give at least {MIN_POINTS}"
        )
    extent = np.linalg.svd(ground.points - ground.points.mean(axis=0), compute_uv=False)
    if extent[1] < MIN_WIDTH_RATIO * extent[0]:
        raise ImpError("the measured points on the floor are on one line; spread them out")
    problem = _Problem(size, boards, ground, sigma, pixel_sigma)
    x, corner = problem.start(), INITIAL_SIGMA
    for _ in range(ROUNDS):
        fit = least_squares(
            problem.residuals, x, problem.jacobian, x_scale="jac", method="lm", args=(corner,)
        )
        x = fit.x
        if not boards:
            break
        corner = problem.corner_noise(x)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac, hermitian=True)[:15, :15]
    camera = CalibratedCamera(*size, x[:15], covariance)
    residuals = camera.project(ground.points) - ground.pixels
    ground_rms = math.sqrt(float(np.mean(residuals**2)))
    board_rms = corner if boards else math.nan
    return CameraCalibration(camera, board_rms, ground_rms, len(boards), problem.odd_point(x))


class _Problem:
    """Least-squares problem; the unknowns are the camera (15,) and the pose (6,) of each board view."""

    def __init__(
        self,
        size: tuple[int, int],
        boards: Sequence[BoardView],
        ground: BoardView,
        sigma: float,
        pixel_sigma: Array,
    ) -> None:
        self._boards, self._ground = boards, ground
        self._noise = sigma, pixel_sigma
        width, height = size
        # Prior of the lens: 30 to 90 degrees wide, axis through the middle, square pixels, no fish-eye.
        self._lens = np.array(
            [width, width, 0.5 * (width - 1), 0.5 * (height - 1), 0, 0, 0, 0, 0], dtype=np.float64
        )
        self._prior_sigma = np.array(
            [0.5 * width, 0.5 * width, 0.03 * width, 0.03 * width, 0.3, 0.3, 0.01, 0.01, 0.3]
        )
        self._size = size

    def start(self) -> Array:
        """Return an initial solution by OpenCV."""
        lens = self._lens.copy()
        if len(self._boards) >= 3:
            points = [view.points.astype(np.float32) for view in self._boards]
            pixels = [view.pixels.astype(np.float32) for view in self._boards]
            flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
            _, matrix, distortion, *_ = cv2.calibrateCamera(
                points, pixels, self._size, None, None, flags=flags
            )
            lens[:4] = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
            lens[4:] = distortion.ravel()[:5]
        poses = [_solve_pose(view, lens) for view in (self._ground, *self._boards)]
        return np.concatenate([poses[0], lens, *poses[1:]])

    def corner_noise(self, x: Array) -> float:
        """Estimate the noise of a board's corners from their residuals, px."""
        residuals = [
            project(vector, view.points) - view.pixels
            for vector, view in zip(self._vectors(x), self._boards, strict=True)
        ]
        free = sum(r.size for r in residuals) - 6 * len(residuals) - 9
        return math.sqrt(sum(float(np.sum(r**2)) for r in residuals) / max(free, 1))

    def odd_point(self, x: Array) -> Array | None:
        """Return the measured point (3,) m that deviates most, None if all fit within their noise.

        Without a board, a wrong point distorts the lens instead, so the prior of the lens counts as well.
        """
        squares = np.sum(self._ground_residuals(x) ** 2, axis=1)
        total, free = float(squares.sum()), 2 * len(squares) - 6
        if not self._boards:
            prior = self._prior_residuals(x)
            total, free = total + float(prior @ prior), free + len(prior) - 9
        if total <= quantile(FIT_PROBABILITY, free):
            return None
        return np.asarray(self._ground.points[np.argmax(squares)])

    def residuals(self, x: Array, corner: float) -> Array:
        """Return all residuals (r,), in standard deviations; `corner` is that of a corner, px."""
        parts = [self._ground_residuals(x).ravel()]
        for vector, view in zip(self._vectors(x), self._boards, strict=True):
            parts.append((project(vector, view.points) - view.pixels).ravel() / corner)
        return np.concatenate([*parts, self._prior_residuals(x)])

    def jacobian(self, x: Array, corner: float) -> Array:
        """Return the derivatives (r, n) of `residuals` by x (n,)."""
        rows = []
        block = np.zeros((2 * len(self._ground.points), len(x)))
        block[:, :15] = linearised(x[:15], self._ground.points)[1]
        rows.append(block / np.repeat(self._ground_sigma(x), 2, axis=0))
        for k, (vector, view) in enumerate(zip(self._vectors(x), self._boards, strict=True)):
            block = np.zeros((2 * len(view.points), len(x)))
            derived = linearised(vector, view.points)[1]
            block[:, LENS] = derived[:, LENS]
            block[:, 15 + 6 * k : 21 + 6 * k] = derived[:, EXTRINSIC]
            rows.append(block / corner)
        prior = np.zeros((10, len(x)))
        prior[np.arange(9), np.arange(6, 15)] = 1.0 / self._prior_sigma
        prior[9, [6, 7]] = np.array([1.0, -1.0]) / (0.01 * self._size[0])
        return np.vstack([*rows, prior])

    def _vectors(self, x: Array) -> list[Array]:
        """Return the camera vector of each board view, relative to the board's frame."""
        return [np.concatenate([x[begin : begin + 6], x[LENS]]) for begin in range(15, len(x), 6)]

    def _ground_residuals(self, x: Array) -> Array:
        """Return the residuals (n, 2) of the measured points, in standard deviations."""
        ground = project(x[:15], self._ground.points) - self._ground.pixels
        return np.asarray(ground / self._ground_sigma(x))

    def _prior_residuals(self, x: Array) -> Array:
        """Return the residuals (10,) of the prior of the lens, in standard deviations."""
        square = (x[6] - x[7]) / (0.01 * self._size[0])
        return np.append((x[LENS] - self._lens) / self._prior_sigma, square)

    def _ground_sigma(self, x: Array) -> Array:
        """Return the noise (n, 1) px of measured points, of their pixels and of the measurement."""
        rotation = cv2.Rodrigues(x[:3])[0]
        depth = self._ground.points @ rotation[2] + x[5]
        measured = self._noise[0] * x[6] / np.maximum(depth, 1e-3)
        return np.asarray(np.hypot(measured, self._noise[1])[:, None])


def _solve_pose(view: BoardView, lens: Array) -> Array:
    """Return the camera pose (6,) of a view with a lens (9,)."""
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    flat = np.ptp(view.points[:, 2]) < 1e-9 and abs(view.points[0, 2]) < 1e-9
    how = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    good, rotation, shift = cv2.solvePnP(view.points, view.pixels, matrix, lens[4:], flags=how)
    if not good:
        raise ImpError("the measured points do not determine the camera's pose; spread them out")
    return np.concatenate([rotation.ravel(), shift.ravel()])
