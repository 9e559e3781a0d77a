"""Every scan aligned once more, with the map of all keyframes as it is known at the end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.errors import ImpError
from impslam.geometry.kernels import kernel, plain
from impslam.surfaces.features import Features, check_rows
from impslam.surfaces.surface_map import (
    CELL,
    REACH,
    Alignment,
    Evidence,
    SurfaceMap,
    add,
    align,
    empty_surface_map,
)
from impslam.types import Array, Ints

MOST_CELLS = 400_000_000  # 1 km^2; 2 GB if every part of it is seen
PRIOR = (
    0.05,
    0.02,
)  # m, rad: how far the tracker's pose may be off, with keyframes refined around it
POINT = 0.03  # m, deviation of a point from its surface
SHARED = 5.0  # points of 4 cm distance that share their error and the surface's, over 25 cm
HOW = Alignment(6, 0.1, 0.05, 1.0 / POINT**2, 1, 9.0)
_AVERAGED = 1000.0  # points in a surfel: nothing that this map shows is to be forgotten


class Rematched(NamedTuple):
    """Scans aligned with a map.

    Attributes
    ----------
    poses : (m, 3)
    shares : (m,) of the points that lie on surfaces of the map
    covariances : (m, 3, 3) of each pose in the map
    """

    poses: Array
    shares: Array
    covariances: Array


class TooLargeError(ImpError):
    """A map whose grid would not fit into memory; the poses stay as they are."""


def surface_map_of(poses: Array, features: Features, starts: Ints) -> SurfaceMap:
    """Return the surfaces of k keyframes at poses (k, 3).

    `features` (p, 5) in base_link, those of keyframe i in rows starts[i] to starts[i + 1] of `starts`
    (k + 1,). Raises `TooLargeError` where the grid would have more than `MOST_CELLS` cells.
    """
    poses = plain(poses)
    check_rows(features, starts, len(poses))
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    _extent(poses, features, starts, low, high)
    if not (low <= high).all():
        return empty_surface_map(CELL, CELL, 1)
    corner = low - (REACH + 2) * CELL  # a surfel needs so much around it
    width, height = high - low + 2 * (REACH + 2) * CELL
    if not width * height < MOST_CELLS * CELL**2:
        raise TooLargeError(
            f"a map of {width:.0f} x {height:.0f} m is too large to match every scan with again, for "
            f"lack of memory (at most {MOST_CELLS * CELL**2 / 1e6:g} km^2): scans stay where they are"
        )
    known = empty_surface_map(width, height, len(features))
    known.corner[:] = corner
    _add_all(known, poses, features, starts)
    return known


def rematch(known: SurfaceMap, poses: Array, features: Features, starts: Ints) -> Rematched:
    """Return m scans aligned with the map from poses (m, 3), which are good to `PRIOR`.

    `features` and `starts` are laid out as for `surface_map_of`. A scan without features keeps its
    pose.

    The covariance is that of the scan in the map as it is, with the prior: it counts `SHARED` points
    as one, since neighbours share a surface's error and their normals. It says nothing of how the map
    itself is bent: where that matters, add the covariance of the keyframes around.
    """
    out = plain(poses).copy()
    check_rows(features, starts, len(out))
    shares, information = np.zeros(len(out)), np.zeros((len(out), 3, 3))
    prior = np.array([PRIOR[0], PRIOR[0], PRIOR[1]]) ** -2.0
    _align_all(known, features, starts, prior, Rematched(out, shares, information))
    covariances = np.linalg.inv(information / SHARED + np.diag(prior))
    return Rematched(out, shares, np.asarray(covariances, np.float64))


@kernel
def _extent(poses: Array, features: Features, starts: Ints, low: Array, high: Array) -> None:
    """Fill low and high (2,) m, the corners of the box around all features in the map."""
    for i in range(len(poses)):
        c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        for p in range(starts[i], starts[i + 1]):
            x = poses[i, 0] + c * features[p, 0] - s * features[p, 1]
            y = poses[i, 1] + s * features[p, 0] + c * features[p, 1]
            low[0], low[1] = min(low[0], x), min(low[1], y)
            high[0], high[1] = max(high[0], x), max(high[1], y)


@kernel
def _add_all(known: SurfaceMap, poses: Array, features: Features, starts: Ints) -> None:
    for i in range(len(poses)):
        add(known, features[starts[i] : starts[i + 1]], poses[i], _AVERAGED)


@kernel
def _align_all(
    known: SurfaceMap, features: Features, starts: Ints, prior: Array, done: Rematched
) -> None:
    """Align `done.poses` in place; fill in the shares and, for now, the points' information."""
    found = Evidence(np.zeros((3, 3)), np.zeros(3), np.zeros(4))
    for k in range(len(done.poses)):
        rows = features[starts[k] : starts[k + 1]]
        done.shares[k] = align(known, rows, done.poses[k], prior, HOW, found)
        done.covariances[k] = HOW.information * found.H
