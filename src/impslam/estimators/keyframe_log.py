"""The keyframes of a drive, and their poses from those of the graph's nodes."""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.building.sightings import SightingsLog
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.angles import wrap
from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose, inverse
from impslam.graph.bearings import Scans
from impslam.graph.bundle import Fit, refine
from impslam.graph.overlaps import Nearness, overlaps
from impslam.graph.pose_graph import Edges
from impslam.growing import GrowingArray
from impslam.map import Keyframe, Keyframes
from impslam.map_builder import valid_points
from impslam.maps.grid import PlacedScans
from impslam.maps.layout import undriven
from impslam.recognition.submap import View, view
from impslam.types import NO_EDGES, Array, Ints, Mask

Points: TypeAlias = npt.NDArray[np.float32]
NO_POINTS: Points = np.empty((0, 2), np.float32)
TURN = 0.3
"""m of way that a radian counts for: it changes the view by about as much."""
APART = 1000.0
"""m of way between two sessions, which is not known: farther than anything is sought along the way."""


class KeyframeLog:
    """The keyframes so far: as tracked, which is never revised, and what each saw.

    Attributes
    ----------
    views : what each saw; None of a sensor that is no lidar, and of those that were dropped
    points : (n, 2) float32 m, the end points of each one's valid beams, in base_link
    seen : the observations of landmarks
    """

    def __init__(self) -> None:
        self.views: list[View | None] = []
        self.points: list[Points] = []
        self.seen = SightingsLog()
        self._chain, self._way, self._steps = GrowingArray(3), GrowingArray(), GrowingArray(3, 3)
        self._nodes, self._sessions = (GrowingArray(dtype=np.int64) for _ in range(2))
        self._hosts, self._T_host = GrowingArray(dtype=np.int64), GrowingArray(3)
        self._seeing = GrowingArray(dtype=np.bool_)

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.views)

    def add(self, keyframe: Keyframe, start: Array | None = None) -> None:
        """Add a keyframe; the first one of a session, which is a node, with the pose (3,) it starts at."""
        scan, seen, points = keyframe.scan, None, NO_POINTS
        if scan is not None:
            seen, points = view(scan), valid_points(scan)
        self.append(keyframe.motion.d_pose, keyframe.motion.covariance, seen, start)
        self.points.append(points)
        self.seen.add(keyframe.observations, keyframe.stamp)

    def append(
        self, d_pose: Array, covariance: Array, seen: View | None, start: Array | None = None
    ) -> None:
        """Add a keyframe by its motion and view; the caller adds to `seen` and `points`."""
        way, session = (self._way.array[-1], self._sessions.array[-1]) if len(self) else (0.0, -1)
        if start is None:
            way = way + np.hypot(d_pose[0], d_pose[1]) + TURN * abs(d_pose[2])
            start = self._chain.array[-1]
        else:
            way, session = way + APART if len(self) else 0.0, session + 1
            self._nodes.append(len(self))
        self._chain.append(compose(start, d_pose))
        self._way.append(way)
        self._sessions.append(session)
        self._steps.append(covariance)
        self._hosts.append(len(self))
        self._T_host.append(0.0)
        self._seeing.append(seen is not None)
        self.views.append(seen)

    def copy(self) -> KeyframeLog:
        """Return a log to read, which this one's later keyframes do not change."""
        other = copy(self)  # arrays are shared: this one only writes behind the other's end
        for name in (
            "_chain",
            "_way",
            "_steps",
            "_nodes",
            "_sessions",
            "_hosts",
            "_T_host",
            "_seeing",
        ):
            setattr(other, name, copy(getattr(self, name)))
        other.views, other.seen = self.views.copy(), self.seen.copy()
        other.points = self.points.copy()
        return other

    def mark_node(self) -> None:
        """Make the newest keyframe a node of the graph."""
        self._nodes.append(len(self) - 1)

    def drop(self, rows: Ints, hosts: Ints, T_host_row: Array) -> None:
        """Drop the views of keyframes (m,), which others, their hosts, see at T (m, 3)."""
        self._hosts.replace(rows, hosts)
        self._T_host.replace(rows, T_host_row)
        self._seeing.replace(rows, np.zeros(len(rows), np.bool_))
        for row in rows.tolist():
            self.views[row], self.points[row] = None, NO_POINTS

    @property
    def hosts(self) -> Ints:
        """The keyframe (k,) that each one's place is known from: itself unless it was dropped."""
        return self._hosts.array

    @property
    def T_host(self) -> Array:
        """Poses (k, 3) of all, seen from their hosts."""
        return self._T_host.array

    @property
    def seeing(self) -> Mask:
        """Whether each (k,) has a view."""
        return self._seeing.array

    @property
    def is_kept(self) -> Mask:
        """Whether each (k,) was not dropped."""
        return np.asarray(self.hosts == np.arange(len(self)))

    @property
    def chain(self) -> Array:
        """Poses (k, 3) as tracked, composed from the start of each session."""
        return self._chain.array

    @property
    def way(self) -> Array:
        """Way (k,) m driven to each, where a radian counts for `TURN` m."""
        return self._way.array

    @property
    def steps(self) -> Array:
        """Covariances (k, 3, 3) of the motion to each from the one before."""
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
    def node_before(self) -> Ints:
        """The newest node (k,) up to each."""
        return np.searchsorted(self.nodes, np.arange(len(self)), side="right") - 1

    @property
    def since_node(self) -> float:
        """Way since the newest node, m."""
        return float(self.way[-1] - self.way[self.nodes[-1]])

    def scans(self, rows: Ints | None = None) -> Scans:
        """Return the features of all keyframes, or of those at some rows (r,)."""
        none = np.empty((0, 5), np.float32)
        views = self.views if rows is None else [self.views[row] for row in rows]
        features = [none if view is None else view.features for view in views]
        lasers = [np.zeros(2) if view is None else view.laser for view in views]
        starts = np.concatenate([[0], np.cumsum([len(r) for r in features])])
        return Scans(np.concatenate([none, *features]), starts, np.array(lasers))

    def keyframes(self, poses: Array, rows: Ints) -> Keyframes:
        """Return some rows (r,) of the keyframes, which lie at poses (k, 3), as a part of a map."""
        points = [self.points[row] for row in rows.tolist()]
        lasers = [
            np.zeros(2) if (v := self.views[row]) is None else v.laser for row in rows.tolist()
        ]
        return Keyframes(
            np.array(self.seen.stamps)[rows],
            poses[rows],
            self.steps[rows],
            np.zeros((len(rows), 3)),
            np.array(lasers),
            np.concatenate([[0], np.cumsum([len(p) for p in points])]),
            np.concatenate([NO_POINTS, *points]),
            **undriven(poses[rows]),
        )

    def placed_scans(self, poses: Array, rows: Ints | None = None) -> PlacedScans:
        """Return the scans of keyframes at poses (k, 3); thinned as their features are."""
        features, starts, lasers = self.scans(rows)
        return PlacedScans(poses, lasers, starts, np.ascontiguousarray(features[:, :2]))


def revised(keys: KeyframeLog, graph: PoseGraph, rows: Ints | None = None) -> Array:
    """Return the poses of all keyframes (k,), or of some rows: each goes with the node before it."""
    rows = np.arange(len(keys)) if rows is None else rows
    node = np.searchsorted(keys.nodes, rows, side="right") - 1
    offset = between(keys.chain[keys.nodes[node]], keys.chain[rows])
    return compose(graph.poses[node], offset)


def spreads(keys: KeyframeLog, graph: PoseGraph) -> Array:
    """Return the covariances (k, 3, 3) of all keyframes: of the node before, and of the motion since."""
    out = np.empty((len(keys), 3, 3))
    motions = np.zeros((len(keys), 3))
    motions[1:] = between(keys.chain[:-1], keys.chain[1:])
    _spread(graph.poses, graph.covariances, keys.nodes, motions, keys.steps, out)
    return out


@kernel
def _spread(
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
    """Return the poses (k, 3) of all keyframes: each between the nodes before and after it.

    After the last node of a session, they go on from it.
    """
    before, after = (ends[keys.node_before] for ends in _legs(keys.sessions[keys.nodes]))
    begin, end = keys.way[keys.nodes[before]], keys.way[keys.nodes[after]]
    share = np.clip((keys.way - begin) / np.where(end > begin, end - begin, 1.0), 0.0, 1.0)
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

    The last leg of a session goes on behind its last node, which is alone if there is no other.
    """
    goes_on = np.append(sessions[1:] == sessions[:-1], False)
    comes_from = np.append(False, goes_on[:-1])
    before = np.arange(len(sessions)) - (~goes_on & comes_from)
    return before, before + (goes_on | comes_from)


class Part(NamedTuple):
    """Which keyframes are refined.

    Attributes
    ----------
    rows : (r,) of the keyframes, ascending
    links : between rows of different sessions, which no motion connects
    frozen : so many of the first keyframes stay where they are, the very first one in any case
    """

    rows: Ints
    links: Edges = NO_EDGES
    frozen: int = 0


def refined(poses: Array, keys: KeyframeLog, rounds: int = 2, part: Part | None = None) -> Array:
    """Return poses (k, 3) with overlapping keyframes laid on each other, in so many rounds.

    They may look any way: a lidar that sees to both sides meets the same walls on a pass there and on
    one back, and pairs that see different ones are found out by their points. Closures within a
    session are no part of it: they rest on the same points, which would count twice.
    """
    rows, links, frozen = part or Part(np.flatnonzero(keys.is_kept))
    edges = motions(keys, rows).joined(links)
    fixed = np.arange(max(1, int(np.searchsorted(rows, frozen))))
    pairs = overlaps(poses[rows], Nearness(turn=math.pi))
    pairs = pairs[(pairs >= len(fixed)).any(axis=1)]
    out = poses.copy()
    scans, fit = keys.scans(rows), Fit(rounds=rounds)
    out[rows] = refine(poses[rows], scans, edges, pairs, fixed, fit).poses
    dropped = ~keys.is_kept
    out[dropped] = compose(out[keys.hosts[dropped]], keys.T_host[dropped])
    return out


STILL = 1e-4
"""m and rad, 1 sigma, added where a robot that stands has none: far below what a scan can tell."""


def motions(keys: KeyframeLog, rows: Ints) -> Edges:
    """Return the motions between keyframes that follow each other, by their places in `rows` (r,).

    For one that was dropped its host stands. Motions between two of these are left out: there are as
    many as are driven, and they tell of hosts what other motions tell.
    """
    place = np.full(len(keys), -1)
    place[rows] = np.arange(len(rows))
    i, j = place[keys.hosts[:-1]], place[keys.hosts[1:]]
    told = (i >= 0) & (j >= 0) & (i != j) & (np.diff(keys.sessions) == 0)
    k = np.flatnonzero(told & (keys.is_kept[:-1] | keys.is_kept[1:]))
    T = compose(keys.T_host[k], between(keys.chain[k], keys.chain[k + 1]))
    T = compose(T, inverse(keys.T_host[k + 1]))
    steps = keys.steps[k + 1]
    still = np.diagonal(steps, axis1=1, axis2=2).min(axis=1) < STILL**2
    steps = steps + STILL**2 * still[:, None, None] * np.eye(3)
    information = np.asarray(np.linalg.inv(steps))
    return Edges(i[k], j[k], T, information, np.full(len(k), np.inf))
