"""Motions of a lidar between two of its scans, each matched by itself, with what they are worth.

Point to line: with q = T p_b, a point of scan b in the frame of scan a, p_a its nearest point there and n
the mean of both normals, e = n . (q - p_a) (Rusinkiewicz 2019, "A symmetric objective function for ICP").
The pose T_a_b = [x, y, yaw] minimises the weighted sum of e^2; errors are additive on it. An error o of
all ranges moves each point along its beam u, so that de/do = n . (R u_b - u_a), and one least squares
tells both. An error of scale cannot be told from the motion: de/ds = -n . t.

Pairs do not share scans, so that their errors are independent. Neither odometry nor the lidar's mount
has a part in them, so that they can be held against both. Points are smoothed along their surface, and the
information counts those that share an error as one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from impslam.calibration.lidar_path import LidarPath, deskewed
from impslam.columns import Columns, Scans
from impslam.geometry.se2 import between, rotation
from impslam.sensors.lidar2d import Lidar2D
from impslam.surfaces.features import Features, beam_spacing, find_features
from impslam.types import Array, Ints

WAY, TURN = 0.3, 0.3
"""m, rad between the scans of a pair: a hundred times the error of a match, and the view is the same."""
LONGEST = 3.0
"""s between them at most: standing tells of a gyro's bias and of the noise."""
MOST = 1500
"""Pairs of a log; of more, as many are taken evenly. What is then left is better known than it is true."""
REACH, NEAR, CLOSE = 0.3, 0.05, 3.0
"""m between points that are paired at first and in the end; and standard deviations of e in the end."""
FACING = 0.9
"""Cosine between the normals of a pair."""
SMOOTH, ALONG, FLAT = 4, 0.25, 0.95
"""Neighbours on either side, m, and cosine between normals, of points that are smoothed."""
FEWEST, SHARE = 30, 0.5
"""Points that match, and their share of the scan with fewer: below, the scans show different places."""
ROUGH = 0.005
"""m: what surfaces are not flat by (skirting, frames, fabric), and what a grazing beam shows of it."""
LEAST = 1e-4
"""Chi-square per point: ranges are no more than 100 times as exact as the config says."""
ROUNDS = 20
SETTLED = 1e-5
"""m, rad: the last step is smaller; a hundredth of what a match is uncertain by."""


class LidarMotions(NamedTuple):
    """m motions of a lidar, whose errors are independent of each other.

    Attributes
    ----------
    begins, ends : (m,) s, middles of the two sweeps, by the scans' own clock
    T_begin_end : (m, 3) of the lidar, if the ranges are right
    joint : (m, 4) [x, y, yaw, range offset] that fit best together, m, m, rad, m
    information : (m, 4, 4) of `joint`
    scatter : (m,) m, standard deviation of the points' distances from the lines
    share : (m,) share of points that match
    """

    begins: Array
    ends: Array
    T_begin_end: Array
    joint: Array
    information: Array
    scatter: Array
    share: Array

    @property
    def covariance(self) -> Array:
        """(m, 3, 3) of `T_begin_end`; the ranges count as right."""
        return np.asarray(np.linalg.pinv(self.information[:, :3, :3], hermitian=True), np.float64)

    def take(self, rows: slice | Ints) -> LidarMotions:
        """Return some of the motions."""
        return LidarMotions(*(column[rows] for column in self))


class Surface(NamedTuple):
    """n points of a scan, smoothed along the surface, and their normals, both (n, 2).

    The nearest of noisy points is one whose error is alike, and what noise does to a pair beyond first
    order makes ranges seem too short. `shared` is how many points have an error in common.
    """

    points: Array
    normals: Array
    shared: float


class Alignment(NamedTuple):
    """Where one scan lies on another; see `LidarMotions`."""

    T_a_b: Array
    joint: Array
    information: Array
    scatter: float
    share: float


def matched_pairs(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath) -> LidarMotions:
    """Return the motions along a path, between scans that are matched with each other."""
    begins, ends = pairs(path)
    rows = np.concatenate((begins, ends))
    features = dict(
        zip(np.sort(rows).tolist(), _features(lidar, scans, path, np.sort(rows)), strict=True)
    )
    found, kept = [], []
    for k, (a, b) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        guess = between(path.poses[a], path.poses[b])
        alignment = align(features[a], features[b], guess, (lidar.sigma, lidar.sigma_per_m))
        if alignment is not None:
            found.append(alignment)
            kept.append(k)
    columns = [np.array(column) for column in zip(*found, strict=True)] if found else _NONE
    return LidarMotions(path.middles[begins[kept]], path.middles[ends[kept]], *columns)


_NONE = [np.empty((0, *shape)) for shape in ((3,), (4,), (4, 4), (), ())]


def pairs(path: LidarPath) -> tuple[Ints, Ints]:
    """Return the rows (m,) of a path at which motions begin and end; no row is in two of them."""
    begins, ends, a = [], [], 0
    for b in range(1, len(path.poses)):
        if not path.trusted[b] or path.middles[b] <= path.middles[b - 1]:
            a = b + 1
        elif b > a:
            x, y, turn = path.poses[b] - path.poses[a]
            late = path.middles[b] - path.middles[a] >= LONGEST
            if math.hypot(x, y) >= WAY or abs(turn) >= TURN or late:
                begins.append(a)
                ends.append(b)
                a = b + 1
    some = np.unique(np.linspace(0, len(begins) - 1, min(len(begins), MOST)).astype(np.int64))
    return np.array(begins, np.int64)[some], np.array(ends, np.int64)[some]


def _features(
    lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, rows: Ints
) -> list[Surface]:
    """Return the surfaces of sweeps, in the lidar's frame in the middle of each."""
    return [
        surface_of(some, k)
        for some in deskewed(lidar, scans, path, rows)
        for k in range(len(some.stamps))
    ]


def surface_of(scans: Scans, k: int) -> Surface:
    """Return what sweep k shows, in the frame of the scans."""
    out = np.empty((len(scans.angles), 5), np.float32)
    spacing = beam_spacing(scans.angles)
    count = find_features(
        scans.points[k], scans.valid[k], scans.ranges[k], scans.origins[k], spacing, 0.0, out
    )
    return surface(out[:count][out[:count, 4] > 0.0])


def surface(features: Features) -> Surface:
    """Return features (n, 5), which are in beam order, with their points smoothed along the surface."""
    points, normals = features[:, :2].astype(np.float64), features[:, 2:4].astype(np.float64)
    total, count = np.zeros(len(points)), np.ones(len(points))
    for step in range(1, SMOOTH + 1):
        for this, other in ((slice(step, None), slice(-step)), (slice(-step), slice(step, None))):
            way = points[other] - points[this]
            same = _dot(normals[this], normals[other]) > FLAT
            same &= np.hypot(way[:, 0], way[:, 1]) < ALONG
            total[this] += same * 0.5 * _dot(normals[this] + normals[other], way)
            count[this] += same
    smooth = points + (total / count)[:, None] * normals
    return Surface(smooth, normals, float(count.mean()) if len(count) else 1.0)


def align(a: Surface, b: Surface, guess: Array, noise: tuple[float, float]) -> Alignment | None:
    """Return where scan b lies on scan a, near a guess (3,); None if they show different places.

    `noise` is the standard deviation of a range at 0 (m) and how much it grows with range; what is
    smaller or larger of it in truth scales the information.
    """
    fewest = min(len(a.points), len(b.points))
    if fewest < FEWEST:
        return None
    trees, pose, scale = (cKDTree(a.points), cKDTree(b.points)), np.array(guess), 1.0
    for k in range(ROUNDS):
        e, J, _ = _misfit(a, b, trees, pose, max(REACH * 0.5**k, NEAR), noise)
        if len(e) < FEWEST:
            return None
        scale = CLOSE * 1.4826 * float(np.median(np.abs(e)))
        WJ = J.T * (1.0 + (e / scale) ** 2) ** -2
        step = np.linalg.lstsq(WJ[:3] @ J[:, :3], -WJ[:3] @ e, rcond=1e-9)[0]
        pose += step
        if np.abs(step).max() < SETTLED:
            break
    e, J, off = _misfit(a, b, trees, pose, NEAR, noise)
    near = np.abs(e) < scale
    count = 0.5 * float(near.sum())  # each point is in two pairs, on average
    if count < FEWEST or count < SHARE * fewest:
        return None
    chi2 = max(0.5 * float(e[near] @ e[near]) / (count - 3.0), LEAST)
    H = 0.5 * J[near].T @ J[near]
    joint = np.append(pose, 0.0) - np.linalg.pinv(H, 1e-9, hermitian=True) @ (
        0.5 * J[near].T @ e[near]
    )
    H /= chi2 * 0.5 * (a.shared + b.shared)
    return Alignment(pose, joint, H, float(off[near].std()), count / fewest)


Trees: TypeAlias = tuple[cKDTree, cKDTree]


def _misfit(
    a: Surface, b: Surface, trees: Trees, pose: Array, reach: float, noise: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Return (k,) how far points of b are off the lines of a, in standard deviations, and in m.

    In between, the derivatives (k, 4) of the first by x, y and yaw of the pose, and by an offset of
    all ranges.
    """
    turn = rotation(float(pose[2])).T  # of rows
    i, j = _paired(a, b, trees, pose, reach)
    m = b.normals[i] @ turn
    facing = _dot(m, a.normals[j]) > FACING
    i, j, m = i[facing], j[facing], m[facing]
    r, p, n = b.points[i] @ turn, a.points[j], m + a.normals[j]
    n /= np.hypot(n[:, 0], n[:, 1])[:, None]
    far_b, far_a = np.hypot(r[:, 0], r[:, 1]), np.hypot(p[:, 0], p[:, 1])
    along_b, along_a = _dot(n, r) / far_b, _dot(n, p) / far_a
    of_b, of_a = ((noise[0] + noise[1] * far) for far in (far_b, far_a))
    sigma = np.hypot(np.hypot(of_b * along_b, of_a * along_a), ROUGH)
    off = _dot(n, r + pose[:2] - p)
    J = np.column_stack((n, n[:, 1] * r[:, 0] - n[:, 0] * r[:, 1], along_b - along_a))
    return off / sigma, J / sigma[:, None], off


def _paired(a: Surface, b: Surface, trees: Trees, pose: Array, reach: float) -> tuple[Ints, Ints]:
    """Return the rows (k,) of b and of a that are paired: the nearest one of each point, both ways.

    Points lie denser nearby, so that the nearest one is more often a near one that was measured too
    long; one way alone, ranges seem to be off by some sigma^2 / r.
    """
    turn, of_a, of_b = rotation(float(pose[2])), np.arange(len(a.points)), np.arange(len(b.points))
    to_a, j = trees[0].query(b.points @ turn.T + pose[:2], distance_upper_bound=reach)
    to_b, i = trees[1].query((a.points - pose[:2]) @ turn, distance_upper_bound=reach)
    there, back = np.isfinite(to_a), np.isfinite(to_b)
    return np.concatenate((of_b[there], i[back])), np.concatenate((j[there], of_a[back]))


def _dot(one: Array, two: Array) -> Array:
    product: Array = np.einsum("ij,ij->i", one, two)
    return product
