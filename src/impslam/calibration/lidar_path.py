"""The path of a lidar, by its scans alone: neither odometry nor the lidar's mount tells anything of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions, Scans, Sweeps
from impslam.geometry.se2 import between, log
from impslam.health import NONE
from impslam.odometry.lidar_only import LidarOnly
from impslam.robot import Robot
from impslam.sensors.lidar2d import Lidar2D
from impslam.tracking.base import Gate
from impslam.tracking.scan_to_map import ScanToMap
from impslam.types import Array, Ints, Mask

LOST, CHUNK = 5, 100
"""Scans in a row that do not fit, after which the tracker is lost; and sweeps that it takes at once."""
NEVER = 1e9
"""m, rad, s: no motion is so long, and no sweep but the first becomes a keyframe."""


class LidarPath(NamedTuple):
    """The poses of a lidar at the middles of n sweeps, in the frame of the first one.

    Attributes
    ----------
    middles : (n,) s, by the scans' own clock
    poses : (n, 3) `T_first_laser`, as the tracker follows it
    trusted : (n,) whether the scan fits what was seen before, and the pose may be used
    located : (n,) whether the scan tells the place, too, along both axes: it does not in a bare corridor
    twists : (n, 3) m/s, m/s, rad/s, body velocity of the lidar over each sweep
    """

    middles: Array
    poses: Array
    trusted: Mask
    located: Mask
    twists: Array


def bare(lidar: Lidar2D) -> Lidar2D:
    """Return a lidar whose base_link is its own place, on its own clock, without extractors."""
    table = lidar.model_dump(exclude={"extractors"})
    return Lidar2D(**{**table, "mount": (0.0, 0.0, 0.0), "latency": 0.0})


def lidar_path(lidar: Lidar2D, scans: Sequence[Columns]) -> LidarPath:
    """Return the path of a lidar by its scans (pieces of one layout each), matched scan to map.

    Stamps should be on one time line. Between sweeps it is predicted at constant velocity. Where scans
    no longer fit it begins anew: only what is relative counts.
    """
    robot = Robot("lidar", LidarOnly(), {"lidar": bare(lidar)})
    clock, follower = bare(lidar), _Follower()
    nothing = np.empty(0, np.bool_)
    found, at = [_Followed(np.empty((0, 3)), nothing, nothing)], [np.empty(0)]
    for piece in scans:
        sensed = [*robot.sense({piece.stream: piece}), *robot.flush()]
        found += [one for motions, sweeps in sensed for one in follower.follow(motions, sweeps)]
        begins, ends = clock.spans(piece)
        at.append(0.5 * (begins + ends))
    moved, trusted, located = map(np.concatenate, zip(*found, strict=True))
    middles, poses = np.concatenate(at), chain(moved)
    return LidarPath(middles, poses, trusted, located, twists(middles, poses))


class _Followed(NamedTuple):
    """Motions (m, 3) to m sweeps; whether each may be used, and tells the place, (m,)."""

    moved: Array
    trusted: Mask
    located: Mask


class _Follower:
    """A tracker that begins anew where it is lost."""

    def __init__(self) -> None:
        self._tracker = ScanToMap()
        self._gate = Gate(np.full(3, NEVER), np.zeros(3))
        self._anew = False

    def follow(self, motions: Motions, sweeps: Sweeps) -> Iterator[_Followed]:
        """Yield what became of the next sweeps, in order."""
        begin = 0
        while begin < len(sweeps):
            rows = slice(begin, begin + CHUNK)
            steps = self._tracker.steps(motions.take(rows), sweeps.take(rows), self._gate)
            trusted = steps.reasons == NONE
            trusted[0] &= not self._anew
            lost = np.convolve(~trusted, np.ones(LOST), "valid") == LOST
            self._anew = bool(lost.any())
            end = int(np.argmax(lost)) + LOST if self._anew else len(trusted)
            yield _Followed(steps.moved[:end], trusted[:end], steps.located[:end])
            begin += end
            if self._anew:
                self._tracker = ScanToMap()


def chain(moved: Array) -> Array:
    """Return poses (n, 3): motions (n, 3) one after another from the origin; headings not wrapped."""
    heading = np.cumsum(moved[:, 2])
    way = (moved[:, 0] + 1j * moved[:, 1]) * np.exp(1j * np.concatenate(([0.0], heading))[:-1])
    place = np.cumsum(way)
    return np.column_stack((place.real, place.imag, heading))


def twists(stamps: Array, poses: Array) -> Array:
    """Return body velocities (n, 3), each by the neighbours on both sides; 0 where stamps stand."""
    n = len(stamps)
    before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    seconds = stamps[after] - stamps[before]
    rate = np.divide(1.0, seconds, out=np.zeros(n), where=seconds > 1e-3)
    return log(between(poses[before], poses[after])) * rate[:, None]


def deskewed(lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, rows: Ints) -> list[Scans]:
    """Return the sweeps in these rows (increasing), each in the lidar's frame in its middle."""
    own, out, start = bare(lidar), list[Scans](), 0
    for piece in scans:
        inside = rows[(rows >= start) & (rows < start + len(piece))]
        if len(inside):
            out.append(own.sweeps(piece.take(inside - start), path.twists[inside]))
        start += len(piece)
    return out
