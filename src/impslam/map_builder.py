"""Collect the tracks and revisions of a run, and return the map as a value at any time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose, motion_lengths
from impslam.growing_array import GrowingArray
from impslam.map import (
    UPPER,
    Keyframe,
    Keyframes,
    Map,
    PathRows,
    Revision,
    Track,
    poses_in_map,
    with_begins,
)
from impslam.maps.grid import Standstill
from impslam.types import Array, Mask, Scan

_DISTINCT = np.ravel_multi_index(UPPER, (3, 3))
"""Indices of the entries of `UPPER` in the flattened matrix."""
NEARNESS_PER_RADIAN = 0.5
"""m that a turn of a radian counts for where sweeps between two keyframes are given to the nearer one."""


class MapBuilder:
    """Stores poses of sweeps relative to keyframes, and the scans of the keyframes.

    It starts with a known map if one is given. With `frozen`, new keyframes serve only the path: neither
    their scans nor the sweeps of the known map are kept.
    """

    def __init__(self, known: Map | None = None, *, frozen: bool = False) -> None:
        self._frozen = frozen
        self._standstill = Standstill()
        self._sweeps = {
            "stamps": GrowingArray(),
            "anchors": GrowingArray(dtype=np.int64),
            "tracked": GrowingArray(3),
            "track_covariances": GrowingArray(6),
            "odometry_poses": GrowingArray(3),
            "live_poses": GrowingArray(3),
        }
        self._keyframes = {
            "stamps": GrowingArray(),
            "poses": GrowingArray(3),
            "covariances": GrowingArray(3, 3),
            "innovations": GrowingArray(3),
            "origins": GrowingArray(2),
            "starts": GrowingArray(dtype=np.int64),
            "points": GrowingArray(2, dtype=np.float32),
            "motions": GrowingArray(3),
            "motion_covariances": GrowingArray(3, 3),
            "sessions": GrowingArray(dtype=np.int64),
            "placed": GrowingArray(dtype=np.bool_),
        }
        if known is None:
            self._keyframes["starts"].append(0)
        else:
            _extend(self._keyframes, known.keyframes)
            if not frozen:
                _extend(self._sweeps, known)

    def __len__(self) -> int:
        """Return the number of sweeps."""
        return len(self._sweeps["stamps"])

    def follow(self, track: Track) -> PathRows:
        """Add a track; return the current estimate of its sweeps' poses."""
        return self._add_sweeps(
            track.anchor, track.stamps, track.T_anchor_base, track.covariance, track.odometry
        )

    def revise(self, keyframe: Keyframe, revision: Revision) -> PathRows:
        """Add a keyframe and update revised ones; return the pose at the keyframe's stamp."""
        kept, moved = self._keyframes, len(revision.ids) - 1
        self._add_to_session(keyframe, revision.begins)
        kept["stamps"].append(keyframe.stamp)
        kept["motions"].append(keyframe.motion.d_pose)
        kept["motion_covariances"].append(keyframe.motion.covariance)
        kept["poses"].append(revision.poses[-1])
        kept["covariances"].append(revision.covariances[-1])
        kept["placed"].append(revision.is_placed)
        if moved:
            placed = np.broadcast_to(revision.placed, moved + 1)
            for name, rows in (
                ("poses", revision.poses), ("covariances", revision.covariances), ("placed", placed),
            ):  # fmt: skip
                kept[name].replace(revision.ids[:-1], rows[:-1])
        self._keep(keyframe, revision)
        if revision.dropped:
            self._drop(revision.dropped)
        return self._add_sweeps(
            keyframe.id,
            np.array([keyframe.stamp]),
            keyframe.T_keyframe_stamp[None],
            keyframe.stamp_covariance[None],
            keyframe.odometry[None],
        )

    def _add_to_session(self, keyframe: Keyframe, begins: tuple[int, ...]) -> None:
        sessions = self._keyframes["sessions"]
        sessions.append(sessions.array[-1] if len(sessions) else 0)
        if keyframe.lost:
            begins = (*begins, keyframe.id)
        if begins:
            sessions.replace(np.arange(len(sessions)), with_begins(sessions.array, begins))

    def _keep(self, keyframe: Keyframe, revision: Revision) -> None:
        kept = self._keyframes
        kept["innovations"].append((len(revision.matches), *revision.nis()))
        scan = keyframe.scan
        is_redundant = self._standstill.is_redundant(revision.poses[-1])
        if is_redundant or scan is None or self._frozen:
            kept["origins"].append(0.0 if scan is None else scan.laser[:2])
        else:
            points = valid_points(scan)
            kept["origins"].append(scan.laser[:2])
            kept["points"].append(points, len(points))
        kept["starts"].append(len(kept["points"]))

    def _drop(self, ids: tuple[int, ...]) -> None:
        """Remove the points of keyframes that are among the newest."""
        first, starts = min(ids), self._keyframes["starts"].array
        begin, lengths = int(starts[first]), np.diff(starts[first:])
        dropped = np.zeros(len(lengths), np.bool_)
        dropped[np.array(ids) - first] = True
        points = self._keyframes["points"].array[begin:]
        kept = points[np.repeat(~dropped, lengths)]
        lengths[dropped] = 0
        ends = begin + np.cumsum(lengths)
        for name, old, new in (("points", len(points), kept), ("starts", len(ends), ends)):
            self._keyframes[name].shorten(old)
            self._keyframes[name].append(new, len(new))

    def _add_sweeps(
        self, anchor: int, stamps: Array, T_anchor_base: Array, covariance: Array, odometry: Array
    ) -> PathRows:
        m, kept = len(stamps), self._sweeps
        kept["stamps"].append(stamps, m)
        kept["anchors"].append(anchor, m)
        kept["tracked"].append(T_anchor_base, m)
        distinct = covariance.reshape(m, 9).take(_DISTINCT, axis=1)
        kept["track_covariances"].append(distinct, m)
        kept["odometry_poses"].append(odometry, m)
        poses, covariances = self._newest_poses(m)
        kept["live_poses"].append(poses, m)
        return PathRows(stamps, poses, covariances, odometry)

    def _newest_poses(self, m: int) -> tuple[Array, Array]:
        """Return the poses (m, 3) of the newest sweeps, and their covariances (m, 3, 3)."""
        keyframes, begin = self._keyframes, len(self) - m
        names = ("anchors", "tracked", "track_covariances")
        new = (self._sweeps[name].array[begin:] for name in names)
        return poses_in_map(keyframes["poses"].array, keyframes["covariances"].array, *new)

    def locate(self, stamp: float, T: Array, covariance: Array, odometry: Array) -> PathRows:
        """Return the pose after `T_keyframe_base` (3,) from the newest keyframe, without storing it."""
        newest = (self._keyframes[name].array[-1:].copy() for name in ("poses", "covariances"))
        poses, covariances = newest
        advance(poses[0], covariances[0], T, covariance)
        return PathRows(np.array([stamp]), poses, covariances, odometry[None])

    def keyframes(self) -> Keyframes:
        """Return the current keyframes."""
        return Keyframes(**{name: column.array for name, column in self._keyframes.items()})

    def map(self) -> Map:
        """Return the current map without landmarks and edges; later data do not change it."""
        sweeps: dict[str, Any] = {name: column.array for name, column in self._sweeps.items()}
        return Map(self.keyframes(), (), **sweeps, T_anchor_base=sweeps["tracked"])


def _extend(columns: dict[str, GrowingArray], rows: object) -> None:
    """Append the arrays of an object to the columns of the same names."""
    for name, column in columns.items():
        array = getattr(rows, name)
        column.append(array, len(array))


def blended(known: Map) -> Map:
    """Return a map whose sweeps are interpolated between the keyframes before and after them.

    Without it, the path has a step at each keyframe that was moved relative to the previous one. The nearer
    keyframe has more weight; see `NEARNESS_PER_RADIAN`.
    """
    keyframes = known.keyframes
    if len(keyframes) < 2:
        return known
    poses, before, T = keyframes.poses, known.anchors, known.tracked
    after = np.minimum(before + 1, len(poses) - 1)
    T_after = between(keyframes.motions[after], T)
    is_between = (after > before) & (keyframes.sessions[after] == keyframes.sessions[before])
    is_between &= np.isfinite(T_after).all(axis=1)
    T_after = np.where(is_between[:, None], T_after, 0.0)
    since, until = (motion_lengths(d, NEARNESS_PER_RADIAN) for d in (T, T_after))
    share = np.where(is_between, since / np.maximum(since + until, 1e-9), 0.0)
    step = between(compose(poses[before], T), compose(poses[after], T_after))
    return replace(known, T_anchor_base=compose(T, share[:, None] * step))


def valid_points(scan: Scan) -> npt.NDArray[np.float32]:
    """Return the end points of the valid beams of a scan, (n, 2) m in base_link."""
    return _valid_points(scan.points, scan.valid)


@kernel
def _valid_points(points: Array, valid: Mask) -> npt.NDArray[np.float32]:
    out = np.empty((valid.sum(), 2), np.float32)
    n = 0
    for i in range(len(valid)):
        if valid[i]:
            out[n, 0], out[n, 1] = points[i, 0], points[i, 1]
            n += 1
    return out
