"""The path of a lidar by its scans alone, independent of odometry and of the lidar's mount."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions, Scans, Sweeps
from impslam.geometry.se2 import between, compose, exp, log
from impslam.health import NONE
from impslam.odometry.lidar_only import LidarOnly
from impslam.robot import Robot
from impslam.sensors.lidar2d import Lidar2D
from impslam.surfaces.features import Sampling, beam_spacing, find_features
from impslam.tracking.base import Gate
from impslam.tracking.scan_to_map import ScanToMap
from impslam.types import Array, Ints, Mask

MAX_MISMATCHES, CHUNK = 5, 100
"""Consecutive scans that do not fit, after which the tracker restarts; and sweeps that are processed
together."""
MIN_INFORMATION = 0.02
"""Smallest information per point of a scan on the weakest combination of x, y and turn; 1 at most. In a
round room with a box it is 0.01, by normals that are off by 0.1 rad; in rooms with corners 0.03 to 0.2."""
EVERY = 3
"""Scans per computation of that: a room does not change its shape from one to the next."""
THIN = 0.04
"""m between points whose normals are counted, as in scan matching."""
MAX_BEND = 0.2
"""rad of turn during a sweep up to which its distortion is linear in the motion: at 10 m, the ends of the
sweep are then off by 5 cm, about as far as points that match."""
NO_LIMIT = 1e9
"""m, rad, s: a gate so wide that only the first sweep becomes a keyframe."""


class LidarPath(NamedTuple):
    """The poses of a lidar at the middles of n sweeps, in the frame of the first one.

    Attributes
    ----------
    middles : (n,) s, by the scans' own clock
    poses : (n, 3) `T_first_laser`, as tracked; without de-skewing unless it was asked for, as the order of
        the beams may be wrong
    trusted : (n,) whether the scan fits the previous ones, so that the pose may be used
    located : (n,) whether the scan also determines the position along both axes, and the turn: not in a
        bare corridor, nor in a round room
    twists : (n, 3) m/s, m/s, rad/s, body velocity of the lidar over each sweep
    """

    middles: Array
    poses: Array
    trusted: Mask
    located: Mask
    twists: Array


def unmounted(lidar: Lidar2D) -> Lidar2D:
    """Return the lidar with base_link at its own origin, on its own clock, without extractors."""
    table = lidar.model_dump(exclude={"extractors"})
    return Lidar2D(**{**table, "mount": (0.0, 0.0, 0.0), "latency": 0.0})


def lidar_path(lidar: Lidar2D, scans: Sequence[Columns], *, deskew: bool = False) -> LidarPath:
    """Return the path of a lidar by scan-to-map matching of its scans (pieces of one layout each).

    Stamps should be on one time line. Motions are predicted at constant velocity. If scans no longer fit,
    the tracker restarts: only relative poses matter. With `deskew`, each sweep is de-skewed by its match.
    """
    robot = Robot("lidar", LidarOnly(), {"lidar": unmounted(lidar)})
    clock, follower = unmounted(lidar), _Follower(deskew=deskew)
    nothing = np.empty(0, np.bool_)
    found, at = [_Followed(np.empty((0, 3)), nothing, nothing)], [np.empty(0)]
    for piece in scans:
        sensed = [*robot.sense({piece.stream: piece}), *robot.flush()]
        found += [one for motions, sweeps in sensed for one in follower.follow(motions, sweeps)]
        begins, ends = clock.spans(piece)
        at.append(0.5 * (begins + ends))
    motion, trusted, located = _joined(found)
    middles, poses = np.concatenate(at), chain(motion)
    return LidarPath(middles, poses, trusted, located, twists(middles, poses))


class _Followed(NamedTuple):
    """Motions (m, 3) to m sweeps; `trusted` and `located` (m,) as in `LidarPath`."""

    motion: Array
    trusted: Mask
    located: Mask


class _Follower:
    """A tracker that restarts when it is lost.

    It matches measured points: smoothed ones bias the wheel radius (by 2.4 sigma on TurtleBot3).
    """

    def __init__(self, *, deskew: bool) -> None:
        self._deskew, self._tracker = deskew, ScanToMap(smooth=False)
        self._gate = Gate(np.full(3, NO_LIMIT), np.zeros(3))
        self._restarted = False

    def follow(self, motions: Motions, sweeps: Sweeps) -> Iterator[_Followed]:
        """Yield the motions to the next sweeps, in order."""
        begin = 0
        assert sweeps.scans is not None
        raw = replace(sweeps.scans, after=None)
        if not self._deskew:
            sweeps = replace(sweeps, scans=raw)
        while begin < len(sweeps):
            rows = slice(begin, begin + CHUNK)
            found = self._follow_chunk(motions.take(rows), sweeps.take(rows))
            end = begin + len(found.motion)
            determined = determines_pose(raw.take(slice(begin, end)))
            yield found._replace(located=found.located & determined)
            begin = end
            if self._restarted:
                self._tracker = ScanToMap(smooth=False)

    def _follow_chunk(self, motions: Motions, sweeps: Sweeps) -> _Followed:
        """Return the motions to these sweeps, or to those until the tracker is lost.

        Only as many are matched at once as it takes to lose it: those after that would be matched again
        after the restart, and where few scans fit, as in thinned logs, it is lost every few scans.
        """
        parts, first, misfits = list[_Followed](), 0, 0
        while first < len(sweeps) and misfits < MAX_MISMATCHES:
            rows = slice(first, first + MAX_MISMATCHES - misfits)
            steps = self._tracker.steps(motions.take(rows), sweeps.take(rows), self._gate)
            trusted = steps.reasons == NONE
            trusted[0] &= first > 0 or not self._restarted
            parts.append(_Followed(steps.moved, trusted, steps.located))
            first += len(trusted)
            misfits = int(np.argmax(trusted[::-1])) if trusted.any() else misfits + len(trusted)
        self._restarted = misfits == MAX_MISMATCHES
        return _joined(parts)


def _joined(parts: Sequence[_Followed]) -> _Followed:
    motions, trusted, located = zip(*parts, strict=True)
    return _Followed(np.concatenate(motions), np.concatenate(trusted), np.concatenate(located))


def determines_pose(scans: Scans) -> Mask:
    """Return (m,) whether the surfaces in each scan determine all of x, y and the heading.

    With lengths in units of the mean distance of the surfaces, a turn counts as much as a shift. The
    normals n of surfaces at p have the information J^T J, J = [n, p x n]; in a round room, all of it about
    the turn around the centre comes from errors of the normals, which move a scan just as well.
    """
    rows = np.arange(0, len(scans.stamps), EVERY)
    at, p, n = _surface_points(scans, rows)
    points = np.maximum(np.bincount(at, minlength=len(rows)), 1)
    size = np.sqrt(np.bincount(at, (p**2).sum(axis=1), len(rows)) / points)
    lever = (p[:, 0] * n[:, 1] - p[:, 1] * n[:, 0]) / size[at]
    J = np.column_stack((n, lever))
    weakest = np.linalg.eigvalsh(_sums(at, len(rows), J, J) / points[:, None, None])[:, 0]
    return np.repeat(weakest > MIN_INFORMATION, EVERY)[: len(scans.stamps)]


def _surface_points(scans: Scans, rows: Ints) -> tuple[Ints, Array, Array]:
    """Return, for the points on surfaces of some scans, the scans (k,), positions and normals (k, 2).

    Scans are given by their places in `rows`.
    """
    sampling = Sampling(beam_spacing(scans.angles), THIN, smooth=False)
    out = np.empty((scans.points.shape[1], 5), np.float32)
    found = [np.empty((0, 5), np.float32)]
    for k in rows.tolist():
        count = find_features(
            scans.points[k], scans.valid[k], scans.ranges[k], scans.origins[k], sampling, out
        )
        found.append(out[:count][out[:count, 4] > 0.0])
    counts = [len(some) for some in found[1:]]
    every = np.concatenate(found).astype(np.float64)
    return np.repeat(np.arange(len(rows)), counts), every[:, :2], every[:, 2:4]


def _sums(at: Ints, count: int, left: Array, right: Array) -> Array:
    """Return (count, a, b): the sum of the products of `left` (k, a) and `right` (k, b) for each scan."""
    sums = np.empty((count, left.shape[1], right.shape[1]))
    for a, b in np.ndindex(*sums.shape[1:]):
        sums[:, a, b] = np.bincount(at, left[:, a] * right[:, b], count)
    return sums


def chain(motions: Array) -> Array:
    """Return poses (n, 3): the motions (n, 3) composed from the origin; headings not wrapped."""
    heading = np.cumsum(motions[:, 2])
    steps = motions[:, 0] + 1j * motions[:, 1]
    position = np.cumsum(steps * np.exp(1j * np.concatenate(([0.0], heading))[:-1]))
    return np.column_stack((position.real, position.imag, heading))


def twists(stamps: Array, poses: Array) -> Array:
    """Return body velocities (n, 3) by central differences; 0 if stamps do not advance."""
    n = len(stamps)
    before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    seconds = stamps[after] - stamps[before]
    rate = np.divide(1.0, seconds, out=np.zeros(n), where=seconds > 1e-3)
    return log(between(poses[before], poses[after])) * rate[:, None]


def undistorted(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath) -> LidarPath:
    """Return a path without the errors that the motion during each sweep causes.

    A point p that is measured t seconds after the middle of a sweep is off by t (v + omega x p) there. To
    first order, this moves the match by the d that minimises the squares of n . (t (v + omega x p) - d),
    with the normals n of the surfaces: if most of what determines the heading is measured early, the scan
    is matched as if it had been taken earlier. If a sweep turns by more than `MAX_BEND`, all are tracked
    again, and each is de-skewed by its match. Sweeps that overlap, by their stamps, stay as they are.
    """
    own, moved = unmounted(lidar), np.zeros_like(path.poses)
    apart = np.gradient(path.middles) if len(path.middles) > 1 else np.zeros(len(path.middles))
    for start, piece in _with_starts(scans):
        begins, ends = own.spans(piece)
        if not (ends > begins).any():
            continue
        timed = np.flatnonzero(apart[start : start + len(piece)] > 0.5 * (ends - begins))
        bends = np.abs(path.twists[start + timed, 2]) * (ends - begins)[timed]
        if (bends[path.trusted[start + timed]] > MAX_BEND).any():
            return lidar_path(lidar, scans, deskew=True)
        raw = own.sweeps(piece, np.zeros((len(piece), 3)))
        for k in range(0, len(timed), CHUNK):
            rows = timed[k : k + CHUNK]
            moved[start + rows] = _distortions(raw, rows, path.twists[start + rows])
    poses = compose(path.poses, exp(-moved))
    poses[:, 2] = path.poses[:, 2] - moved[:, 2]  # not wrapped
    return path._replace(poses=poses)


def _distortions(raw: Scans, rows: Ints, twists: Array) -> Array:
    """Return the twists (k, 3) m, m, rad by which the motion during some sweeps moves their matches."""
    if raw.after is None:
        return np.zeros((len(rows), 3))
    at, p, n = _surface_points(raw, rows)
    t = np.interp(np.arctan2(p[:, 1], p[:, 0]), raw.angles, raw.after, period=math.tau)
    J = np.column_stack((n, p[:, 0] * n[:, 1] - p[:, 1] * n[:, 0]))
    off = t * (J * twists[at]).sum(axis=1)
    information = _sums(at, len(rows), J, J)
    # 1e-12 of the largest eigenvalue is 1e-6 of the largest singular value of J
    covariance = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    return np.asarray((covariance @ _sums(at, len(rows), J, off[:, None]))[..., 0], np.float64)


def _with_starts(scans: Sequence[Columns]) -> Iterator[tuple[int, Columns]]:
    """Yield each piece with the row of the path at which it begins."""
    start = 0
    for piece in scans:
        yield start, piece
        start += len(piece)


def deskewed(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, rows: Ints) -> list[Scans]:
    """Return the sweeps in these rows (increasing), each in the lidar's frame at its middle."""
    own, out = unmounted(lidar), list[Scans]()
    for start, piece in _with_starts(scans):
        inside = rows[(rows >= start) & (rows < start + len(piece))]
        if len(inside):
            out.append(own.sweeps(piece.take(inside - start), path.twists[inside]))
    return out
