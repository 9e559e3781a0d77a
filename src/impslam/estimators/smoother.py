"""All poses of a drive and all landmarks as one factor graph, solved incrementally with iSAM2.

iSAM2 (Kaess, Johannsson, Roberts, Ila, Leonard & Dellaert 2012), here that of gtsam, keeps the factorised
graph as a Bayes tree. New factors change only its top, and only variables that moved by more than a
threshold are relinearised. With z = h(pose, m) of a landmark's model, the factors are

    motion       between(x_k-1, x_k) - d            noise Q,
    observation  h(x_k, m) + s b - z                noise R - s s^T,
    first one    m [-] initialise(x_k, z)           noise m_D_z (R - s s^T) m_D_z^T + slack,

the last one for kinds that a single observation does not determine. b, of unit variance, is the common
error of a sensor's observations, and s the error of z per unit of b.

Poses are perturbed in their own frame, as in gtsam: additive errors are T(theta) times these, with
T = diag(R(theta), 1). A landmark is `retract(anchor, delta)` with its initial state as anchor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np

from impslam.errors import ConfigError, NumericalError, in_a_line
from impslam.extras import install
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, block_rotation, compose
from impslam.landmarks.base import STEP, LandmarkModel
from impslam.types import Array, Observation

Error: TypeAlias = Callable[[Any, Any, Any], Array]
"""Error of a factor: takes factor, values, and None or a list for Jacobians; returns the residual."""

_MIN_SIGMA = 1e-6  # m, rad, of a motion, so that its covariance is invertible
_CONVERGED = 1e-6  # m, rad, last step of Gauss-Newton
_MAX_ITERATIONS = 20  # of Gauss-Newton


def library() -> Any:
    """Return gtsam.

    Raises
    ------
    ConfigError
        If it is not installed.
    """
    try:
        return import_module("gtsam")
    except ImportError:
        raise ConfigError(
            f"estimator 'smoothing' needs the library gtsam; install it with `{install('graph')}`"
        ) from None


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """A landmark in the graph: its model and its initial state (dim,)."""

    model: LandmarkModel
    anchor: Array

    def state(self, delta: Array) -> Array:
        """Return the state (dim,)."""
        return np.asarray(self.model.retract(self.anchor[None], delta[None])[0])

    def jacobian(self, delta: Array) -> Array:
        """Return the derivative (dim, dim) of the state, in its own perturbation, by delta."""
        steps = STEP * np.eye(len(delta))
        if type(self.model).retract is LandmarkModel.retract:
            return np.eye(len(delta))
        here = np.broadcast_to(self.state(delta), (2 * len(delta), len(delta)))
        there = self.model.retract(
            np.broadcast_to(self.anchor, here.shape), delta + np.concatenate([steps, -steps])
        )
        ahead, back = np.split(self.model.difference(here, there), 2)
        return np.asarray((ahead - back).T / (2.0 * STEP))


@dataclass(frozen=True, slots=True, eq=False)
class SmootherEstimate:
    """Poses (n, 3) with covariances (n, 3, 3), and the landmarks' states and covariances by id."""

    poses: Array
    covariances: Array
    landmarks: dict[int, tuple[Array, Array]]


class Smoother:
    """An incrementally growing graph; `poses` is the number of its poses, which are numbered in order."""

    def __init__(self, pose: Array, sigma: float, threshold: float) -> None:
        """Begin at a pose (3,) of standard deviation `sigma`, m and rad; see `Smoothing.relinearise`."""
        self._gtsam = g = library()
        self._isam, self._marks = _isam2(g, threshold), dict[int, Mark]()
        self._factors, self._values = g.NonlinearFactorGraph(), g.Values()
        self._errors: dict[str, int] = {}
        self.poses = 1
        self._values.insert(_x(0), g.Pose2(*pose))
        noise = g.noiseModel.Isotropic.Sigma(3, sigma)
        self._factors.add(g.PriorFactorPose2(_x(0), g.Pose2(*pose), noise))
        self.solve()

    def add_motion(self, d_pose: Array, covariance: Array) -> None:
        """Add the pose after a motion (3,) with the covariance (3, 3) of its additive error."""
        g, begin, end = self._gtsam, _x(self.poses - 1), _x(self.poses)
        before = self._isam.calculateEstimatePose2(begin)
        noise = covariance + _MIN_SIGMA**2 * np.eye(3)
        self._factors.add(g.CustomFactor(_gaussian(g, noise), [begin, end], _motion_error(d_pose)))
        self._values.insert(end, before.compose(g.Pose2(*d_pose)))
        self.poses += 1

    def add_landmark(
        self, number: int, model: LandmarkModel, observation: Observation, pose: Array
    ) -> None:
        """Add a landmark by its first observation from the newest pose (3,), as currently estimated."""
        new = model.initialise(pose, observation)
        self._marks[number] = mark = Mark(model, new.m)
        self._values.insert(_m(number), np.zeros(model.dim))
        if model.dim == model.dim_z:
            self.add_observation(number, observation)
            return
        s, R = self._shared(observation)
        noise = new.m_D_z @ R @ new.m_D_z.T + new.slack
        error = _first_observation_error(mark, observation, new.m_D_z @ s)
        self._add(number, observation, noise, error)

    def add_observation(
        self, number: int, observation: Observation, inflation: float = 1.0
    ) -> None:
        """Add an observation of a landmark from the newest pose, with R times `inflation`."""
        s, R = self._shared(observation)
        error = _observation_error(self._marks[number], observation.z, s)
        self._add(number, observation, inflation * R, error)

    def solve(self) -> int:
        """Update the solution with the added factors; return the number of relinearised variables."""
        result = self._isam.update(self._factors, self._values)
        self._factors, self._values = self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()
        return int(result.getVariablesRelinearized())

    def pose(self) -> tuple[Array, Array]:
        """Return the newest pose (3,) and its covariance (3, 3), additive in map."""
        key = _x(self.poses - 1)
        pose = _array(self._isam.calculateEstimatePose2(key))
        return pose, _additive(pose, self._isam.marginalCovariance(key))

    def path(self) -> Array:
        """Return all poses (n, 3)."""
        return np.asarray(self._gtsam.utilities.extractPose2(self._isam.calculateEstimate()))

    def landmark(self, number: int) -> Array:
        """Return the state (dim,) of a landmark."""
        return self._marks[number].state(self._isam.calculateEstimateVector(_m(number)))

    def optimum(self, checkpoint: Callable[[], None] = lambda: None) -> SmootherEstimate:
        """Return the optimum of the whole graph with its marginals; this object does not change.

        `checkpoint` is called between iterations, and may end them with an exception.

        Raises
        ------
        NumericalError
            If there is no optimum.
        """
        try:
            return self._optimum(checkpoint)
        except RuntimeError as error:
            raise NumericalError(in_a_line(error)) from None

    def _optimum(self, checkpoint: Callable[[], None]) -> SmootherEstimate:
        g, isam = self._gtsam, _isam2(self._gtsam, _CONVERGED)  # with the options of the old one
        checkpoint()
        isam.update(self._isam.getFactorsUnsafe(), self._isam.calculateBestEstimate())
        for _ in range(_MAX_ITERATIONS):
            checkpoint()
            if isam.update().getVariablesRelinearized() == 0:
                break
        best = isam.calculateBestEstimate()
        poses = np.asarray(g.utilities.extractPose2(best))
        P = [_additive(pose, isam.marginalCovariance(_x(k))) for k, pose in enumerate(poses)]
        found = {}
        for number, mark in self._marks.items():
            delta = best.atVector(_m(number))
            D = mark.jacobian(delta)
            found[number] = mark.state(delta), D @ isam.marginalCovariance(_m(number)) @ D.T
        return SmootherEstimate(poses, np.array(P), found)

    def _shared(self, observation: Observation) -> tuple[Array, Array]:
        """Return the error of z (dz,) per unit of its sensor's common error, or 0, and R without it."""
        if observation.shared is None:
            return np.zeros(len(observation.z)), observation.R
        if observation.sensor not in self._errors:
            self._errors[observation.sensor] = key = _b(len(self._errors))
            unit = self._gtsam.noiseModel.Isotropic.Sigma(1, 1.0)
            self._values.insert(key, np.zeros(1))
            self._factors.add(self._gtsam.PriorFactorVector(key, np.zeros(1), unit))
        s = observation.shared
        return s, observation.R - np.outer(s, s)

    def _add(self, number: int, observation: Observation, noise: Array, error: Error) -> None:
        keys = [_x(self.poses - 1), _m(number)]
        if observation.shared is not None:
            keys.append(self._errors[observation.sensor])
        model = _gaussian(self._gtsam, noise)
        self._factors.add(self._gtsam.CustomFactor(model, keys, error))


def _motion_error(d_pose: Array) -> Error:
    """Return the error function of a motion (3,).

    The factor of gtsam omits the rotation of the error from its Jacobians, which matters if the turn is
    uncertain but sideways slip is not.
    """

    def error(factor: Any, values: Any, jacobians: Any) -> Array:
        keys = factor.keys()
        begin, end = _array(values.atPose2(keys[0])), _array(values.atPose2(keys[1]))
        motion = between(begin, end)
        if jacobians is not None:
            x, y, theta = motion.tolist()
            jacobians[0] = np.array([[-1.0, 0.0, y], [0.0, -1.0, -x], [0.0, 0.0, -1.0]], order="F")
            jacobians[1] = np.asfortranarray(block_rotation(theta))
        out = motion - d_pose
        out[2] = wrap(float(out[2]))
        return np.asarray(out)

    return error


def _observation_error(mark: Mark, z: Array, s: Array) -> Error:
    """Return the error function of an observation z (dz,)."""

    def error(factor: Any, values: Any, jacobians: Any) -> Array:
        keys = factor.keys()
        pose, delta = _array(values.atPose2(keys[0])), values.atVector(keys[1])
        predicted = mark.model.predict(pose, mark.state(delta)[None])
        out = -mark.model.residual(z[None], predicted.z)[0]
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(predicted.z_D_pose[0] @ block_rotation(float(pose[2])))
            jacobians[1] = np.asfortranarray(predicted.z_D_m[0] @ mark.jacobian(delta))
        return _with_shared(out, s, keys, values, jacobians)

    return error


def _first_observation_error(mark: Mark, observation: Observation, s: Array) -> Error:
    """Return the error function of a first observation; its Jacobians are central differences."""
    steps = STEP * np.concatenate([np.eye(3), -np.eye(3)])

    def difference(pose: Array, m: Array) -> Array:
        initial = mark.model.initialise(pose, observation).m
        return np.asarray(mark.model.difference(initial[None], m[None])[0])

    def error(factor: Any, values: Any, jacobians: Any) -> Array:
        keys = factor.keys()
        pose, delta = _array(values.atPose2(keys[0])), values.atVector(keys[1])
        m = mark.state(delta)
        if jacobians is not None:
            moved = np.array([difference(compose(pose, step), m) for step in steps])
            jacobians[0] = np.asfortranarray((moved[:3] - moved[3:]).T / (2.0 * STEP))
            h = STEP * np.eye(len(delta))
            moved = np.array(
                [difference(pose, mark.state(delta + sign * d)) for sign in (1, -1) for d in h]
            )
            ahead, back = np.split(moved, 2)
            jacobians[1] = np.asfortranarray((ahead - back).T / (2.0 * STEP))
        return _with_shared(difference(pose, m), s, keys, values, jacobians)

    return error


def _with_shared(error: Array, s: Array, keys: Any, values: Any, jacobians: Any) -> Array:
    """Return an error (d,) plus the common error, s (d,) per standard deviation."""
    if len(keys) == 2:
        return error
    if jacobians is not None:
        jacobians[2] = np.asfortranarray(s[:, None])
    return np.asarray(error + s * values.atVector(keys[2])[0])


def _x(k: int) -> int:
    return ord("x") << 56 | k


def _m(number: int) -> int:
    return ord("m") << 56 | number


def _b(k: int) -> int:
    return ord("b") << 56 | k


def _array(pose: Any) -> Array:
    return np.array([pose.x(), pose.y(), pose.theta()])


def _additive(pose: Array, P: Array) -> Array:
    """Return a covariance (3, 3) in a pose's own frame as one of additive errors in map."""
    T = block_rotation(float(pose[2]))
    out = T @ P @ T.T
    return np.asarray(0.5 * (out + out.T))


def _isam2(gtsam: Any, threshold: float) -> Any:
    """Return an empty iSAM2 that relinearises variables that moved by more than `threshold`, m and rad."""
    params, steps = gtsam.ISAM2Params(), gtsam.ISAM2GaussNewtonParams()
    steps.setWildfireThreshold(1e-2 * threshold)
    params.setOptimizationParams(steps)
    params.setRelinearizeThreshold(threshold)
    params.relinearizeSkip = 1
    params.setFactorization("QR")  # Cholesky fails if sideways slip is ruled out
    return gtsam.ISAM2(params)


def _gaussian(gtsam: Any, covariance: Array) -> Any:
    return gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T))
