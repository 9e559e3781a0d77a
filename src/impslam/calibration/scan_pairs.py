"""Motions of a lidar between pairs of its scans, with their information.

Point to line: with q = T p_b, a point of scan b in the frame of scan a, p_a its nearest point there and n
the mean of both normals, e = n . (q - p_a) (Rusinkiewicz 2019, "A symmetric objective function for ICP").
The pose T_a_b = [x, y, yaw] minimises the weighted sum of e^2; errors are additive on it. An error o of
all ranges moves each point along its beam u, so that de/do = n . (R u_b - u_a), and one least-squares fit
gives both. A scale error cannot be separated from the motion: de/ds = -n . t.

Pairs do not share scans, so their errors are independent. They use neither odometry nor the lidar's mount,
so they can be compared with both. Points are smoothed along their surface, and the information counts
points with a common error as one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import LidarPath, deskewed
from impslam.calibration.pair_kernels import (
    MIN_FACING,
    IndexedSurface,
    find_misfit,
    find_nearest,
    smooth_along,
)
from impslam.columns import Columns, Scans
from impslam.geometry.kernels import plain
from impslam.geometry.se2 import between, rotation, transform
from impslam.sensors.lidar2d import Lidar2D
from impslam.surfaces.features import Features, Sampling, beam_spacing, find_features
from impslam.types import Array, Ints

PAIR_DISTANCE, PAIR_TURN = 0.3, 0.3
"""m, rad between the scans of a pair: a hundred times the error of a match, with nearly the same view."""
MAX_INTERVAL = 3.0
"""s between them: pairs without motion give the bias of a gyro and the noise."""
MAX_PAIRS = 1500
"""Pairs of a log; if there are more, they are thinned evenly. More would reduce only the random errors."""
START_RADIUS, END_RADIUS, END_SIGMAS = 0.3, 0.05, 3.0
"""m between paired points, at first and in the end; and standard deviations of e in the end."""
MIN_POINTS, MIN_SHARE = 30, 0.5
"""Points that match, and their share of the smaller scan: below, the scans show different places."""
MIN_CHI2 = 1e-4
"""Lower bound of chi-square per point: ranges are at most 100 times as exact as configured."""
SHAPE_SIGMA = 0.0015
"""m: systematic error of a range offset due to corners and to correlated errors of points and normals: 0.1
to 0.4 mm in simulations, 2 mm with another simulator's lidar. It does not average out over drives."""
MIN_DETERMINED = 10.0
"""Information along an axis, in multiples of that by errors of the normals, from which scans determine it.
Along a bare wall it is 1, in rooms 100 or more."""
UNDETERMINED = 0.01
"""1/m^2, 1/rad^2: that of an unknown motion. A robot drives less than 10 m in `MAX_INTERVAL`."""
MAX_ITERATIONS = 20
CONVERGENCE = 1e-5
"""m, rad of the last step: a hundredth of the uncertainty of a match."""


class LidarMotions(NamedTuple):
    """m motions of a lidar with independent errors.

    Attributes
    ----------
    begins, ends : (m,) s, middles of the two sweeps, by the scans' own clock
    T_begin_end : (m, 3) of the lidar, for a range offset of 0
    joint : (m, 4) [x, y, yaw, range offset] of the joint fit, m, m, rad, m
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
        """(m, 3, 3) of `T_begin_end`, without a range offset."""
        return np.asarray(np.linalg.pinv(self.information[:, :3, :3], hermitian=True), np.float64)

    def take(self, rows: slice | Ints) -> LidarMotions:
        """Return some of the motions."""
        return LidarMotions(*(column[rows] for column in self))


class Surface(NamedTuple):
    """n points of a scan, smoothed along the surface, and their normals, both (n, 2).

    Without smoothing, nearest-neighbour pairs favour points with similar errors, and the second-order
    effect of noise makes ranges look too short. `shared` is the mean number of points with a common error,
    and `by_x` (n,) are the rows of the points in the order of x.
    """

    points: Array
    normals: Array
    shared: float
    by_x: Ints


class PairAlignment(NamedTuple):
    """Pose of one scan relative to another; see `LidarMotions`."""

    T_a_b: Array
    joint: Array
    information: Array
    scatter: float
    share: float


class AlignedPair(NamedTuple):
    """Two sweeps, the earlier and the later, and the pose of the later in the earlier.

    Attributes
    ----------
    rows : of the path
    surfaces : in the lidar's frame
    middles : rad, of the fields of view
    alignment : None if they show different places
    """

    rows: tuple[int, int]
    surfaces: tuple[Surface, Surface]
    middles: tuple[float, float]
    alignment: PairAlignment | None


def match_pairs(
    lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, most: int = MAX_PAIRS
) -> LidarMotions:
    """Return the motions along a path between pairs of scans, each pair matched independently.

    If there are more than `most` pairs, they are thinned evenly.
    """
    return motions_of(align_pairs(lidar, scans, path, most), path)


def motions_of(aligned: Sequence[AlignedPair], path: LidarPath) -> LidarMotions:
    """Return the motions of the pairs that show one place."""
    found = [(pair.rows, pair.alignment) for pair in aligned if pair.alignment is not None]
    begins, ends = np.array([rows for rows, _ in found], np.int64).reshape(-1, 2).T
    alignments = [alignment for _, alignment in found]
    columns = [np.array(c) for c in zip(*alignments, strict=True)] if alignments else _NONE
    return LidarMotions(path.middles[begins], path.middles[ends], *columns)


def align_pairs(
    lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, most: int = MAX_PAIRS
) -> list[AlignedPair]:
    """Return the pairs of scans along a path, see `pairs`, each aligned independently."""
    begins, ends = pairs(path, most)
    rows = np.sort(np.concatenate((begins, ends)))
    views = [
        (sweep_surface(some, k), 0.5 * float(some.angles[0] + some.angles[-1]))
        for some in deskewed(lidar, scans, path, rows)
        for k in range(len(some.stamps))
    ]
    views_of = dict(zip(rows.tolist(), views, strict=True))
    noise, aligned = (lidar.sigma, lidar.sigma_per_m), []
    for a, b in zip(begins.tolist(), ends.tolist(), strict=True):
        surfaces, middles = zip(views_of[a], views_of[b], strict=True)
        found = align(*surfaces, between(path.poses[a], path.poses[b]), noise)
        aligned.append(AlignedPair((a, b), surfaces, middles, found))
    return aligned


_NONE = [np.empty((0, *shape)) for shape in ((3,), (4,), (4, 4), (), ())]


def pairs(path: LidarPath, most: int = MAX_PAIRS) -> tuple[Ints, Ints]:
    """Return the rows (m,) of a path at which motions begin and end; each row is used at most once.

    A pair ends one row after its motion is long enough. If it ended at that row, it would end as soon as
    the noise of its own scan lengthens its motion, and the matched motions would be too long.
    """
    begins, ends, a, first = [], [], 0, 0
    for b in range(1, len(path.poses)):
        if not path.trusted[b] or path.middles[b] <= path.middles[b - 1]:
            a = first = b + 1
        elif b > a:
            before = min(1, a - first)
            x, y, turn = path.poses[b - before] - path.poses[a - before]
            late = path.middles[b] - path.middles[a] >= MAX_INTERVAL
            if math.hypot(x, y) >= PAIR_DISTANCE or abs(turn) >= PAIR_TURN or late:
                begins.append(a)
                ends.append(b)
                a = b + 1
    some = np.unique(np.linspace(0, len(begins) - 1, min(len(begins), most)).astype(np.int64))
    return np.array(begins, np.int64)[some], np.array(ends, np.int64)[some]


def sweep_surface(scans: Scans, k: int) -> Surface:
    """Return the surface of sweep k, in the frame of the scans."""
    out = np.empty((len(scans.angles), 5), np.float32)
    sampling = Sampling(beam_spacing(scans.angles), 0.0, smooth=False)
    count = find_features(
        scans.points[k], scans.valid[k], scans.ranges[k], scans.origins[k], sampling, out
    )
    return surface(out[:count][out[:count, 4] > 0.0])


def surface(features: Features) -> Surface:
    """Return the surface of features (n, 5) in beam order, with points smoothed along it."""
    points, normals = features[:, :2].astype(np.float64), features[:, 2:4].astype(np.float64)
    smooth = np.empty_like(points)
    shared = smooth_along(points, normals, smooth)
    return Surface(smooth, normals, shared, np.argsort(smooth[:, 0]))


def align(a: Surface, b: Surface, guess: Array, noise: tuple[float, float]) -> PairAlignment | None:
    """Return the pose of scan b in scan a, near a guess (3,); None if they show different places.

    `noise` is the standard deviation of a range at 0 (m), and its growth with range; the information is
    scaled to the residuals.
    """
    smaller = min(len(a.points), len(b.points))
    if smaller < MIN_POINTS:
        return None
    pose, scale = np.array(guess), 1.0
    for k in range(MAX_ITERATIONS):
        e, J, *_ = _misfit(a, b, pose, max(START_RADIUS * 0.5**k, END_RADIUS), noise)
        if len(e) < MIN_POINTS:
            return None
        sigma = 1.4826 * _median(np.abs(e))  # 0 if the lidar repeats a scan
        scale = END_SIGMAS * max(sigma, math.sqrt(MIN_CHI2))
        WJ = J.T * (1.0 + (e / scale) ** 2) ** -2
        step = np.linalg.lstsq(WJ[:3] @ J[:, :3], -WJ[:3] @ e, rcond=1e-9)[0]
        pose += step
        if np.abs(step).max() < CONVERGENCE:
            break
    e, J, off, J_errors = _misfit(a, b, pose, END_RADIUS, noise)
    near = np.abs(e) < scale
    count = 0.5 * float(near.sum())  # each point is in two pairs, on average
    if count < MIN_POINTS or count < MIN_SHARE * smaller:
        return None
    chi2 = max(0.5 * float(e[near] @ e[near]) / (count - 3.0), MIN_CHI2)
    H = 0.5 * J[near].T @ J[near]
    joint = np.append(pose, 0.0) - np.linalg.pinv(H, 1e-9, hermitian=True) @ (
        0.5 * J[near].T @ e[near]
    )
    spurious = 0.5 * J_errors[near].T @ J_errors[near]
    scale = 1.0 / (chi2 * 0.5 * (a.shared + b.shared))
    information = _determined(scale * H, scale * spurious)
    return PairAlignment(pose, joint, information, float(off[near].std()), count / smaller)


def _determined(H: Array, spurious: Array) -> Array:
    """Return the information H (4, 4) without that on poses that only errors of normals determine.

    Such errors make a bare wall look as if it determined the position along itself: they contribute
    `spurious` (4, 4). Along axes v of poses with H v = w spurious v and small w, the variance of an unknown
    motion is added to that of the match (Woodbury's identity).
    """
    known = 1e-6 * H.diagonal()[:3] + 1e-9  # normals are known to 1 mrad at best
    inverse = np.linalg.inv(np.linalg.cholesky(spurious[:3, :3] + np.diag(known)))
    w, U = np.linalg.eigh(inverse @ H[:3, :3] @ inverse.T)
    out = H.copy()
    for v in (inverse.T @ U)[:, w < MIN_DETERMINED].T:
        unit = v / np.linalg.norm(v)
        along = out[:, :3] @ unit
        out -= np.outer(along, along) / (UNDETERMINED + along[:3] @ unit)
    return out


def _misfit(
    a: Surface, b: Surface, pose: Array, radius: float, noise: tuple[float, float]
) -> tuple[Array, Array, Array, Array]:
    """Return normalised distances (k,) of points of b from lines of a, their derivatives, and m (k,).

    The derivatives (k, 4) of the normalised distances are by x, y and yaw of the pose, and by an offset of
    all ranges. The last result is the distances in m.
    """
    out = np.empty((len(a.points) + len(b.points), 10))
    of_a, of_b = (
        IndexedSurface(plain(s.points), plain(s.normals), s.points[s.by_x], s.by_x) for s in (a, b)
    )
    out = out[: find_misfit(of_a, of_b, plain(pose), radius, noise, out)]
    return out[:, 0], out[:, 1:5], out[:, 5], out[:, 6:]


def facing_partners(
    a: Surface, b: Surface, T_a_b: Array, radius: float
) -> tuple[Ints, Ints, Array]:
    """Return rows (k,) of a and b whose points are nearest and face alike, and those of b in a's frame.

    Each point of b is paired with the nearest one of a within `radius` m.
    """
    points, normals = transform(T_a_b, b.points), b.normals @ rotation(float(T_a_b[2])).T
    partners = nearest(points, a.points, radius)
    i = np.flatnonzero(partners >= 0)
    i = i[_dot(normals[i], a.normals[partners[i]]) > MIN_FACING]
    return partners[i], i, points[i]


def nearest(points: Array, others: Array, radius: float) -> Ints:
    """Return for each point (k, 2) the row of the nearest of others (m, 2) within `radius` m, else -1."""
    order, found = np.argsort(others[:, 0]), np.empty(len(points), np.int64)
    find_nearest(plain(points), plain(others[order]), radius, found)
    found[found >= 0] = order[found[found >= 0]]
    return found


def _median(values: Array) -> float:
    """Return the median of values (n,), without the search for NaN, which takes most of numpy's time."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (low, high))
    return 0.5 * float(ordered[low] + ordered[high])


def _dot(one: Array, two: Array) -> Array:
    product: Array = np.einsum("ij,ij->i", one, two)
    return product
