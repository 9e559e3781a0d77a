"""Collects the tracks and revisions of a run, and returns the map as a value at any time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose
from impslam.growing import GrowingArray
from impslam.map import UPPER, Keyframe, Keyframes, Map, PathRows, Revision, Track, hang
from impslam.types import NO_EDGES, Array, Edges, Landmark, Mask, Scan

_DISTINCT = np.ravel_multi_index(UPPER, (3, 3))
"""Where the entries of `UPPER` are in a matrix's nine."""
TURN = 0.5
"""m of way that a radian counts for: it changes the view by about as much."""


class MapBuilder:
    """Stores poses of sweeps relative to keyframes, and the scans of the keyframes."""

    def __init__(self) -> None:
        self._stamps, self._anchors = GrowingArray(), GrowingArray(dtype=np.int64)
        self._T_anchor_base, self._covariances = GrowingArray(3), GrowingArray(6)
        self._odometry, self._live = GrowingArray(3), GrowingArray(3)
        self._key_stamps, self._poses = GrowingArray(), GrowingArray(3)
        self._motions = GrowingArray(3)
        self._pose_covariances = GrowingArray(3, 3)
        self._innovations, self._origins = GrowingArray(3), GrowingArray(2)
        self._starts, self._points = GrowingArray(dtype=np.int64), GrowingArray(2, dtype=np.float32)
        self._starts.append(0)

    def __len__(self) -> int:
        """Return the number of sweeps."""
        return len(self._stamps)

    def follow(self, track: Track) -> PathRows:
        """Add a track; return the current estimate of its sweeps' poses."""
        return self._hang(
            track.anchor, track.stamps, track.T_anchor_base, track.covariance, track.odometry
        )

    def revise(self, keyframe: Keyframe, revision: Revision) -> PathRows:
        """Add a keyframe and update revised ones; return the pose at the keyframe's stamp."""
        own = revision.ids == keyframe.id
        self._key_stamps.append(keyframe.stamp)
        self._motions.append(keyframe.motion.d_pose)
        self._poses.append(revision.poses[own])
        self._pose_covariances.append(revision.covariances[own])
        if len(own) > 1:
            self._poses.replace(revision.ids[~own], revision.poses[~own])
            self._pose_covariances.replace(revision.ids[~own], revision.covariances[~own])
        self._keep(keyframe, revision)
        return self._hang(
            keyframe.id,
            np.array([keyframe.stamp]),
            keyframe.T_keyframe_stamp[None],
            keyframe.stamp_covariance[None],
            keyframe.odometry[None],
        )

    def _keep(self, keyframe: Keyframe, revision: Revision) -> None:
        nis = sum(match.distance2 for match in revision.matches)
        dof = sum(len(match.innovation) for match in revision.matches)
        self._innovations.append((len(revision.matches), nis, dof))
        scan = keyframe.scan
        if scan is None:
            self._origins.append(0.0)
        else:
            points = valid_points(scan)
            self._origins.append(scan.laser[:2])
            self._points.append(points, len(points))
        self._starts.append(len(self._points))

    def _hang(
        self, anchor: int, stamps: Array, T_anchor_base: Array, covariance: Array, odometry: Array
    ) -> PathRows:
        m = len(stamps)
        self._stamps.append(stamps, m)
        self._anchors.append(anchor, m)
        self._T_anchor_base.append(T_anchor_base, m)
        self._covariances.append(covariance.reshape(m, 9).take(_DISTINCT, axis=1), m)
        self._odometry.append(odometry, m)
        poses, covariances = self._place(m)
        self._live.append(poses, m)
        return PathRows(stamps, poses, covariances, odometry)

    def _place(self, m: int) -> tuple[Array, Array]:
        """Return the poses (m, 3) of the newest sweeps, and their covariances (m, 3, 3)."""
        new = (self._anchors, self._T_anchor_base, self._covariances)
        return hang(
            self._poses.array, self._pose_covariances.array, *(c.array[len(c) - m :] for c in new)
        )

    def blended(self, known: Map) -> Map:
        """Return a map with each sweep between where the keyframes before and after it have it.

        Keyframes that were moved against each other leave a step before each of them otherwise. A
        sweep goes with the keyframe that saw most alike: a radian counts for `TURN` m.
        """
        if len(known.keyframes) < 2:
            return known
        poses, before, T = known.keyframes.poses, known.anchors, known.T_anchor_base
        after = np.minimum(before + 1, len(poses) - 1)
        T_after = between(self._motions.array[after], T)
        told = (after > before) & np.isfinite(T_after).all(axis=1)
        T_after = np.where(told[:, None], T_after, 0.0)
        way, ahead = (np.hypot(d[:, 0], d[:, 1]) + TURN * np.abs(d[:, 2]) for d in (T, T_after))
        share = np.where(told, way / np.maximum(way + ahead, 1e-9), 0.0)
        step = between(compose(poses[before], T), compose(poses[after], T_after))
        return replace(known, T_anchor_base=compose(T, share[:, None] * step))

    def locate(self, stamp: float, T: Array, spread: Array, odometry: Array) -> PathRows:
        """Return the pose at `T_keyframe_base` (3,) from the newest keyframe, without storing it."""
        poses, covariances = self._poses.array[-1:].copy(), self._pose_covariances.array[-1:].copy()
        advance(poses[0], covariances[0], T, spread)
        return PathRows(np.array([stamp]), poses, covariances, odometry[None])

    def keyframes(self) -> Keyframes:
        """Return the current keyframes."""
        return Keyframes(
            self._key_stamps.array,
            self._poses.array,
            self._pose_covariances.array,
            self._innovations.array,
            self._origins.array,
            self._starts.array,
            self._points.array,
        )

    def map(
        self,
        landmarks: tuple[Landmark, ...],
        about: dict[str, Any] | None = None,
        edges: Edges = NO_EDGES,
    ) -> Map:
        """Return the current map; later data do not change it."""
        return Map(
            self.keyframes(),
            landmarks,
            self._stamps.array,
            self._anchors.array,
            self._T_anchor_base.array,
            self._covariances.array,
            self._odometry.array,
            self._live.array,
            edges,
            about or {},
        )


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
