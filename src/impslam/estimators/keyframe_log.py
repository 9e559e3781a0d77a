"""The keyframes of a drive, and their poses relative to the nodes of the graph."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.building.sightings import SightingsLog
from impslam.estimators.pose_graph import PoseGraph, between_hosts
from impslam.geometry.angles import wrap
from impslam.geometry.chain import advance
from impslam.geometry.covariances import inverse_of
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose, motion_lengths
from impslam.graph.bearings import ScanFeatures
from impslam.graph.bundle import RefinementSettings, refine
from impslam.graph.overlaps import Nearness, overlaps
from impslam.growing_array import GrowingArray
from impslam.map import Keyframe, Keyframes, session_starts
from impslam.map_builder import valid_points
from impslam.maps.grid import PlacedScans
from impslam.maps.layout import undriven
from impslam.recognition.submap import View, view
from impslam.surfaces.features import Features
from impslam.types import NO_EDGES, Array, Edges, Ints, Mask

Points: TypeAlias = npt.NDArray[np.float32]
NO_POINTS: Points = np.empty((0, 2), np.float32)
DRIVEN_PER_RADIAN = 0.3
"""m that a turn of a radian counts for in the distance driven, which spaces nodes and limits the drift
between them. Other purposes have other values: `map_builder`, `maps.relation`, `graph.overlaps`."""
SESSION_GAP = 1000.0
"""m, distance set between two sessions, where it is unknown: longer than any search along the drive."""


class KeyframeLog:
    """The keyframes so far: their tracked motions, which are never revised, and their views.

    Attributes
    ----------
    views : features of each scan; None without a lidar scan, and for dropped keyframes
    points : (n, 2) float32 m, end points of the valid beams of each, in base_link
    sightings : the observations of landmarks
    """

    def __init__(self) -> None:
        self.views: list[View | None] = []
        self.points: list[Points] = []
        self.sightings = SightingsLog()
        self._chain = GrowingArray(3)
        self._distance = GrowingArray()
        self._steps = GrowingArray(3, 3)
        self._nodes, self._sessions = (GrowingArray(dtype=np.int64) for _ in range(2))
        self._hosts, self._T_host = GrowingArray(dtype=np.int64), GrowingArray(3)
        self._has_view = GrowingArray(dtype=np.bool_)

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.views)

    def add(self, keyframe: Keyframe, start: Array | None = None) -> None:
        """Add a keyframe; the first one of a session becomes a node, with its start pose (3,)."""
        scan, features, points = keyframe.scan, None, NO_POINTS
        if scan is not None:
            features, points = view(scan), valid_points(scan)
        self.append(keyframe.motion.d_pose, keyframe.motion.covariance, features, start)
        self.points.append(points)
        self.sightings.add(keyframe.observations, keyframe.stamp)

    def append(
        self, d_pose: Array, covariance: Array, features: View | None, start: Array | None = None
    ) -> None:
        """Add a keyframe by its motion (3,) and (3, 3) and its view.

        The caller adds to `sightings` and `points`.
        """
        distance, session = 0.0, -1
        if len(self):
            distance, session = self._distance.array[-1], self._sessions.array[-1]
        if start is None:
            distance += float(motion_lengths(d_pose, DRIVEN_PER_RADIAN))
            start = self._chain.array[-1]
        else:
            distance, session = distance + SESSION_GAP if len(self) else 0.0, session + 1
            self._nodes.append(len(self))
        self._chain.append(compose(start, d_pose))
        self._distance.append(distance)
        self._sessions.append(session)
        self._steps.append(covariance)
        self._hosts.append(len(self))
        self._T_host.append(0.0)
        self._has_view.append(features is not None)
        self.views.append(features)

    def copy(self) -> KeyframeLog:
        """Return a copy for reading, which later keyframes of this one do not change."""
        other = copy(self)  # arrays are shared: this one only writes beyond the other's end
        for name, column in vars(self).items():
            if isinstance(column, GrowingArray):
                setattr(other, name, copy(column))
        other.views, other.sightings = self.views.copy(), self.sightings.copy()
        other.points = self.points.copy()
        return other

    def mark_node(self) -> None:
        """Make the newest keyframe a node of the graph."""
        self._nodes.append(len(self) - 1)

    def begin_session(self, row: int) -> None:
        """Begin a session at an earlier keyframe, which is a node."""
        if row in self.begins:
            return
        rows = np.arange(row, len(self))
        self._sessions.replace(rows, self.sessions[row:] + 1)
        self._distance.replace(rows, self.distance[row:] + SESSION_GAP)

    def drop(self, rows: Ints, hosts: Ints, T_host_row: Array) -> None:
        """Remove the views of keyframes (m,), and define them by T (m, 3) relative to their hosts."""
        self._hosts.replace(rows, hosts)
        self._T_host.replace(rows, T_host_row)
        self._has_view.replace(rows, np.zeros(len(rows), np.bool_))
        for row in rows.tolist():
            self.views[row], self.points[row] = None, NO_POINTS

    @property
    def hosts(self) -> Ints:
        """The keyframe (k,) to which the pose of each is relative: itself unless it was dropped."""
        return self._hosts.array

    @property
    def T_host(self) -> Array:
        """Poses (k, 3) of all, relative to their hosts."""
        return self._T_host.array

    @property
    def has_view(self) -> Mask:
        """Whether each (k,) has a view."""
        return self._has_view.array

    @property
    def is_kept(self) -> Mask:
        """Whether each (k,) was not dropped."""
        return np.asarray(self.hosts == np.arange(len(self)))

    @property
    def chain(self) -> Array:
        """Poses (k, 3) as tracked, composed from the start of each session."""
        return self._chain.array

    @property
    def distance(self) -> Array:
        """Distance (k,) m driven up to each, with `DRIVEN_PER_RADIAN` for turns."""
        return self._distance.array

    @property
    def steps(self) -> Array:
        """Covariances (k, 3, 3) of the motion to each from the previous one."""
        return self._steps.array

    @property
    def nodes(self) -> Ints:
        """Keyframes (n,) that are nodes of the graph."""
        return self._nodes.array

    @property
    def sessions(self) -> Ints:
        """Number (k,) of the session of each."""
        return self._sessions.array

    @property
    def begins(self) -> tuple[int, ...]:
        """The first keyframe of each session."""
        return tuple(np.flatnonzero(session_starts(self.sessions)).tolist())

    @property
    def node_before(self) -> Ints:
        """The newest node (k,) up to each."""
        return np.searchsorted(self.nodes, np.arange(len(self)), side="right") - 1

    @property
    def since_node(self) -> float:
        """Distance since the newest node, m."""
        return float(self.distance[-1] - self.distance[self.nodes[-1]])

    def scans(self, rows: Ints | None = None) -> ScanFeatures:
        """Return the features of all keyframes, or of those at some rows (r,)."""
        none = np.empty((0, 5), np.float32)
        views = self.views if rows is None else [self.views[row] for row in rows]
        features = [none if view is None else view.features for view in views]
        lasers = [np.zeros(2) if view is None else view.laser for view in views]
        return ScanFeatures(
            np.concatenate([none, *features]), _starts(features), np.reshape(lasers, (-1, 2))
        )

    def keyframes(self, poses: Array, rows: Ints) -> Keyframes:
        """Return some rows (r,) of the keyframes, with poses (k, 3) of all, as part of a map."""
        points = [self.points[row] for row in rows.tolist()]
        lasers = [
            np.zeros(2) if (v := self.views[row]) is None else v.laser for row in rows.tolist()
        ]
        return Keyframes(
            np.array(self.sightings.stamps)[rows],
            poses[rows],
            self.steps[rows],
            np.zeros((len(rows), 3)),
            np.reshape(lasers, (-1, 2)),
            _starts(points),
            np.concatenate([NO_POINTS, *points]),
            **undriven(poses[rows]),
        )

    def placed_scans(self, poses: Array, rows: Ints | None = None) -> PlacedScans:
        """Return the scans of all keyframes, or of some rows (r,), thinned like their features.

        `poses` (k, 3) or (r, 3) are those of the same keyframes.
        """
        features, starts, lasers = self.scans(rows)
        return PlacedScans(poses, lasers, starts, np.ascontiguousarray(features[:, :2]))


def _starts(parts: Sequence[Array | Features]) -> Ints:
    """Return where each of k parts begins in all of them together, and their end: (k + 1,)."""
    return np.cumsum([0, *map(len, parts)], dtype=np.int64)


def revised(keys: KeyframeLog, graph: PoseGraph, rows: Ints | None = None) -> Array:
    """Return the poses of all keyframes (k,), or of some rows, relative to the nodes before them."""
    rows = np.arange(len(keys)) if rows is None else rows
    node = np.searchsorted(keys.nodes, rows, side="right") - 1
    offset = between(keys.chain[keys.nodes[node]], keys.chain[rows])
    return compose(graph.poses[node], offset)


def keyframe_covariances(keys: KeyframeLog, graph: PoseGraph) -> Array:
    """Return the covariances (k, 3, 3) of all keyframes: the node before, plus the motion since."""
    out = np.empty((len(keys), 3, 3))
    motions = np.zeros((len(keys), 3))
    motions[1:] = between(keys.chain[:-1], keys.chain[1:])
    _propagate(graph.poses, graph.covariances, keys.nodes, motions, keys.steps, out)
    return out


@kernel
def _propagate(
    poses: Array, covariances: Array, nodes: Ints, motions: Array, steps: Array, out: Array
) -> None:
    """Fill `out` from n nodes and the motions (k, 3) to each keyframe, with their covariances."""
    n, pose, P = 0, np.empty(3), np.empty((3, 3))
    for k in range(len(out)):
        if n < len(nodes) and nodes[n] == k:
            pose[:], P[:] = poses[n], covariances[n]
            n += 1
        else:
            advance(pose, P, motions[k], steps[k])
        out[k] = P


def blended(keys: KeyframeLog, graph: PoseGraph) -> Array:
    """Return the poses (k, 3) of all keyframes, interpolated between the nodes before and after.

    After the last node of a session, they are relative to that node.
    """
    before, after = (ends[keys.node_before] for ends in _legs(keys.sessions[keys.nodes]))
    begin, end = keys.distance[keys.nodes[before]], keys.distance[keys.nodes[after]]
    share = np.clip((keys.distance - begin) / np.where(end > begin, end - begin, 1.0), 0.0, 1.0)
    chain = keys.chain[keys.nodes]
    first = compose(graph.poses[before], between(chain[before], keys.chain))
    second = compose(graph.poses[after], between(chain[after], keys.chain))
    difference = second - first
    difference[:, 2] = wrap(difference[:, 2])
    poses = first + share[:, None] * difference
    poses[:, 2] = wrap(poses[:, 2])
    return np.asarray(poses)


def _legs(sessions: Ints) -> tuple[Ints, Ints]:
    """Return the nodes (n,) at both ends of the leg that begins at each of n nodes.

    At the last node of a session the previous leg is extrapolated; a single node is both ends.
    """
    has_next = np.append(sessions[1:] == sessions[:-1], False)
    has_previous = np.append(False, has_next[:-1])
    before = np.arange(len(sessions)) - (~has_next & has_previous)
    return before, before + (has_next | has_previous)


class Part(NamedTuple):
    """The keyframes to refine.

    Attributes
    ----------
    rows : (r,) of the keyframes, ascending
    links : between rows of different sessions, which no motion connects
    frozen : number of first keyframes that do not move; the very first one never does
    """

    rows: Ints
    links: Edges = NO_EDGES
    frozen: int = 0


def refined(poses: Array, keys: KeyframeLog, rounds: int = 2, part: Part | None = None) -> Array:
    """Return poses (k, 3) after aligning overlapping keyframes with each other, in `rounds` rounds.

    Any relative heading counts as overlap: a lidar that sees to both sides meets the same walls on a pass
    there and back, and pairs that see different walls are rejected by their points. Closures within a
    session are left out: they are based on the same points, which would count twice.
    """
    rows, links, frozen = part or Part(np.flatnonzero(keys.is_kept))
    edges = motions(keys, rows).joined(links)
    fixed = np.arange(max(1, int(np.searchsorted(rows, frozen))))
    pairs = overlaps(poses[rows], Nearness(turn=math.pi))
    pairs = pairs[(pairs >= len(fixed)).any(axis=1)]
    out = poses.copy()
    scans, fit = keys.scans(rows), RefinementSettings(rounds=rounds)
    out[rows] = refine(poses[rows], scans, edges, pairs, fixed, fit).poses
    dropped = ~keys.is_kept
    out[dropped] = compose(out[keys.hosts[dropped]], keys.T_host[dropped])
    return out


def motions(keys: KeyframeLog, rows: Ints) -> Edges:
    """Return the motions between consecutive keyframes, with indices into `rows` (r,).

    A dropped keyframe is replaced by its host. Motions between two dropped ones are left out: their number
    grows with the distance driven, and other motions connect the hosts.
    """
    index = np.full(len(keys), -1)
    index[rows] = np.arange(len(rows))
    i, j = index[keys.hosts[:-1]], index[keys.hosts[1:]]
    is_within = (i >= 0) & (j >= 0) & (i != j) & (np.diff(keys.sessions) == 0)
    k = np.flatnonzero(is_within & (keys.is_kept[:-1] | keys.is_kept[1:]))
    step, none = between(keys.chain[k], keys.chain[k + 1]), np.zeros((len(k), 3, 3))
    T, P = between_hosts(
        (keys.T_host[k], none), (step, keys.steps[k + 1]), (keys.T_host[k + 1], none)
    )
    return Edges(i[k], j[k], T, inverse_of(P), np.full(len(k), np.inf))
