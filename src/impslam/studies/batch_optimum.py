"""The batch optimum: the most likely path and map given all data up to a step.

A filter's efficiency is measured against it: no estimator does better with the same data and Gaussian
noise. All poses and landmarks are estimated jointly by Gauss-Newton (Dellaert & Kaess 2006) from the
normalised residuals of odometry and measurements. Poses [x, y, theta] and landmarks [x, y] are perturbed
by addition.

The poses' part A of the normal equations is block tridiagonal, so a banded Cholesky factorisation and the
Schur complement on the few landmarks solve 400 poses in milliseconds:

    [A  B ] [dx]   [a]
    [B^T C] [dm] = [b],    (C - B^T A^-1 B) dm = b - B^T A^-1 a.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose, transform
from impslam.studies.circle_simulation import START_SIGMA, Setting, Trial
from impslam.types import Array, Ints

LATERAL_SIGMA = 1e-5
"""m per step: replaces the 0 across the robot, which would make the weights infinite."""
_CONVERGED = 1e-7  # m and rad
_ITERATIONS = 20


class Optimum(NamedTuple):
    """The last pose (3,) of the most likely path up to a step, and its covariance (3, 3)."""

    step: int
    pose: Array
    covariance: Array


def optima(setting: Setting, trial: Trial, steps: Sequence[int]) -> Iterator[Optimum]:
    """Yield the batch optimum of the data up to each of the steps, in ascending order."""
    poses = trial.truth[:1].copy()
    landmarks = np.full((setting.landmarks, 2), np.nan)
    for step in steps:
        for k in range(len(poses), step + 1):
            poses = np.vstack([poses, compose(poses[-1], trial.odometry[k - 1])])
            new = trial.in_range[k - 1] & np.isnan(landmarks[:, 0])
            landmarks[new] = transform(poses[-1], trial.measurements[k - 1, new])
        covariance = _minimise(_Problem(setting, trial, step), poses, landmarks)
        yield Optimum(step, poses[-1].copy(), covariance)


def _minimise(problem: _Problem, poses: Array, landmarks: Array) -> Array:
    """Move poses and landmarks to the optimum, in place; return the last pose's covariance."""
    for _ in range(_ITERATIONS):
        d_pose, d_landmark, covariance = problem.solve(poses, landmarks)
        poses += d_pose
        poses[:, 2] = wrap(poses[:, 2])
        landmarks[problem.known] += d_landmark
        if max(np.abs(d_pose).max(), np.abs(d_landmark).max()) < _CONVERGED:
            break
    return covariance


class _Problem:
    """The residuals of the data up to a step."""

    def __init__(self, setting: Setting, trial: Trial, step: int) -> None:
        self.origin, self.odometry = trial.truth[0], trial.odometry[:step]
        self.motion_weights = np.maximum(setting.motion_sigmas, LATERAL_SIGMA) ** -2.0
        self.weight = setting.sigma**-2.0
        at, which = np.nonzero(trial.in_range[:step])
        self.at: Ints = at + 1
        self.measured = trial.measurements[at, which]
        self.known: Ints = np.unique(which)
        self.which: Ints = np.searchsorted(self.known, which)

    def solve(self, poses: Array, landmarks: Array) -> tuple[Array, Array, Array]:
        """Return the Gauss-Newton step of poses and known landmarks, and the last pose's covariance."""
        diagonal, below, a = self._motion(poses)
        B, C, b = self._measurements(poses, landmarks[self.known], diagonal, a)
        factor = cholesky_banded(_banded(diagonal, below), lower=True)
        last = np.eye(len(a), 3, -(len(a) - 3))
        A_inv = cho_solve_banded((factor, True), np.column_stack([a, last, B]))
        dx, last, A_inv_B = A_inv[:, 0], A_inv[:, 1:4], A_inv[:, 4:]
        schur = C - B.T @ A_inv_B
        dm = np.linalg.solve(schur, b - B.T @ dx)
        covariance = last[-3:] + A_inv_B[-3:] @ np.linalg.solve(schur, A_inv_B[-3:].T)
        return (dx - A_inv_B @ dm).reshape(-1, 3), dm.reshape(-1, 2), covariance

    def _motion(self, poses: Array) -> tuple[Array, Array, Array]:
        """Return the poses' diagonal blocks, those below them, and the right-hand side."""
        n, W = len(poses), self.motion_weights
        c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        d = poses[1:] - poses[:-1]
        moved = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=1)
        residual = self.odometry - moved
        residual[:, 2] = wrap(residual[:, 2])
        by_second = np.zeros((n - 1, 3, 3))
        by_second[:, 0, 0], by_second[:, 0, 1] = c, s
        by_second[:, 1, 0], by_second[:, 1, 1], by_second[:, 2, 2] = -s, c, 1.0
        by_first = -by_second
        by_first[:, 0, 2], by_first[:, 1, 2] = moved[:, 1], -moved[:, 0]
        diagonal, a = np.zeros((n, 3, 3)), np.zeros((n, 3))
        first_W, second_W = (J.transpose(0, 2, 1) * W for J in (by_first, by_second))
        diagonal[:-1] += first_W @ by_first
        diagonal[1:] += second_W @ by_second
        a[:-1] += np.einsum("nij,nj->ni", first_W, residual)
        a[1:] += np.einsum("nij,nj->ni", second_W, residual)
        diagonal[0] += np.eye(3) / START_SIGMA**2
        a[0] += (self.origin - poses[0]) / START_SIGMA**2
        return diagonal, second_W @ by_first, a.ravel()

    def _measurements(
        self, poses: Array, landmarks: Array, diagonal: Array, a: Array
    ) -> tuple[Array, Array, Array]:
        """Add the measurements to the poses' blocks and right-hand side; return B, C and b."""
        at, which, w = self.at, self.which, self.weight
        c, s = np.cos(poses[at, 2]), np.sin(poses[at, 2])
        d = landmarks[which] - poses[at, :2]
        z = np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=1)
        residual = self.measured - z
        by_place = np.stack([np.stack([c, s], 1), np.stack([-s, c], 1)], axis=1)
        by_pose = np.concatenate([-by_place, np.stack([z[:, 1], -z[:, 0]], 1)[:, :, None]], axis=2)
        pose_T, place_T = (w * J.transpose(0, 2, 1) for J in (by_pose, by_place))
        np.add.at(diagonal, at, pose_T @ by_pose)
        np.add.at(a.reshape(-1, 3), at, np.einsum("nij,nj->ni", pose_T, residual))
        k = len(landmarks)
        B, C, b = np.zeros((len(poses), 3, k, 2)), np.zeros((k, 2, k, 2)), np.zeros((k, 2))
        B[at, :, which] = pose_T @ by_place
        np.add.at(b, which, np.einsum("nij,nj->ni", place_T, residual))
        C[np.arange(k), :, np.arange(k)] = w * np.bincount(which)[:, None, None] * np.eye(2)
        return B.reshape(-1, 2 * k), C.reshape(2 * k, 2 * k), b.ravel()


def _banded(diagonal: Array, below: Array) -> Array:
    """Return block-tridiagonal 3x3 blocks in LAPACK's lower banded form (6, 3 n)."""
    out = np.zeros((6, len(diagonal), 3))
    for row in range(3):
        for column in range(3):
            if row >= column:
                out[row - column, :, column] = diagonal[:, row, column]
            out[3 + row - column, :-1, column] = below[:, row, column]
    return out.reshape(6, -1)
