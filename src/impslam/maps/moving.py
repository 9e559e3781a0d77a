"""Transformation of a map to another frame: covariances of poses, and landmarks.

Errors are additive on [x, y, theta] in map, so a motion T = [t, phi] of the map rotates a covariance by
J = diag(R(phi), 1), for any t. Relative data (tracks, edges, scans) do not change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import block_rotation, rotation, transform
from impslam.types import Array, Landmark


def moved_covariances(T: Array, covariances: Array) -> Array:
    """Return covariances (..., 3, 3) of poses after the map has moved by T (3,)."""
    J = block_rotation(float(T[2]))
    return np.asarray(J @ covariances @ J.T)


def moved_landmark(T: Array, landmark: Landmark) -> Landmark:
    """Return a landmark after the map has moved by T (3,).

    The covariance of a line is that of r and alpha, that of a point of x and y. A landmark that is a frame
    has the parameter yaw, rad.
    """
    ends = None if landmark.end_points is None else transform(T, landmark.end_points)
    values, J = dict(landmark.parameters), _jacobian(T, landmark)
    position = transform(T, landmark.position)
    if landmark.is_line:
        values["r"], values["alpha"], _ = _moved_line(T, values["r"], values["alpha"])
        position = values["r"] * np.array([math.cos(values["alpha"]), math.sin(values["alpha"])])
    values |= dict(zip(("x", "y"), position.tolist(), strict=True)) if "x" in values else {}
    values |= {"yaw": wrap(values["yaw"] + float(T[2]))} if "yaw" in values else {}
    covariance = J @ landmark.covariance @ J.T
    return replace(
        landmark, position=position, parameters=values, covariance=covariance, end_points=ends
    )


def moved_joint(T: Array, landmarks: Sequence[Landmark], covariance: Array) -> Array:
    """Return the joint covariance (2 k, 2 k) of landmarks after the map has moved; (0, 0) if empty."""
    if not covariance.size:
        return covariance
    J = np.array([_jacobian(T, landmark) for landmark in landmarks])
    k = len(J)
    blocks = covariance.reshape(k, 2, k, 2)
    moved = np.einsum("iab,ibjd,jcd->iajc", J, blocks, J, optimize=True)
    return np.asarray(moved.reshape(2 * k, 2 * k))


def _jacobian(T: Array, landmark: Landmark) -> Array:
    """Return the derivative (2, 2) of a landmark's estimated values after T by those before."""
    if not landmark.is_line:
        return rotation(float(T[2]))
    return _moved_line(T, landmark.parameters["r"], landmark.parameters["alpha"])[2]


def _moved_line(T: Array, r: float, alpha: float) -> tuple[float, float, Array]:
    """Return r >= 0 and alpha of a line after T, and their Jacobian (2, 2) by the previous ones.

    The line {p : p . n(alpha) = r} becomes p . n(a) = r + t . n(a) with a = alpha + phi.
    """
    rotated = alpha + float(T[2])
    c, s = math.cos(rotated), math.sin(rotated)
    distance = r + c * float(T[0]) + s * float(T[1])
    sign = -1.0 if distance < 0.0 else 1.0
    lever = c * float(T[1]) - s * float(T[0])
    by_before = np.array([[sign, sign * lever], [0.0, 1.0]])
    return sign * distance, wrap(rotated + (math.pi if sign < 0.0 else 0.0)), by_before
