"""The keyframes of a drive, and their poses from those of the graph's nodes."""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from impslam.building.sightings import SightingsLog
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose
from impslam.graph.bearings import Scans
from impslam.graph.bundle import Fit, refine
from impslam.graph.overlaps import Nearness, overlaps
from impslam.graph.pose_graph import Edges
from impslam.growing import GrowingArray
from impslam.map import Keyframe
from impslam.maps.grid import PlacedScans
from impslam.recognition.submap import View, view
from impslam.types import Array, Ints

TURN = 0.3
"""m of way that a radian counts for: it changes the view by about as much."""


class KeyframeLog:
    """The keyframes so far: as tracked, which is never revised, and what each saw.

    Attributes
    ----------
    views : what each saw; None of a sensor that is no lidar
    seen : the observations of landmarks
    """

    def __init__(self) -> None:
        self.views: list[View | None] = []
        self.seen = SightingsLog()
        self._chain, self._way, self._steps = GrowingArray(3), GrowingArray(), GrowingArray(3, 3)
        self._nodes = GrowingArray(dtype=np.int64)

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.views)

    def add(self, keyframe: Keyframe, start: Array | None = None) -> None:
        """Add a keyframe; the first one, which is a node, with the pose (3,) where the run starts."""
        d_pose = keyframe.motion.d_pose
        if start is None:
            way = self._way.array[-1] + np.hypot(d_pose[0], d_pose[1]) + TURN * abs(d_pose[2])
            start = self._chain.array[-1]
        else:
            way = 0.0
            self._nodes.append(0)
        self._chain.append(compose(start, d_pose))
        self._way.append(way)
        self._steps.append(keyframe.motion.covariance)
        self.views.append(None if keyframe.scan is None else view(keyframe.scan))
        self.seen.add(keyframe.observations, keyframe.stamp)

    def copy(self) -> KeyframeLog:
        """Return a log to read, which this one's later keyframes do not change."""
        other = copy(self)  # arrays are shared: this one only writes behind the other's end
        for name in ("_chain", "_way", "_steps", "_nodes"):
            setattr(other, name, copy(getattr(self, name)))
        other.views, other.seen = self.views.copy(), self.seen.copy()
        return other

    def mark_node(self) -> None:
        """Make the newest keyframe a node of the graph."""
        self._nodes.append(len(self) - 1)

    @property
    def chain(self) -> Array:
        """Poses (k, 3) as tracked, composed from the start."""
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
    def node_before(self) -> Ints:
        """The newest node (k,) up to each."""
        return np.searchsorted(self.nodes, np.arange(len(self)), side="right") - 1

    @property
    def since_node(self) -> float:
        """Way since the newest node, m."""
        return float(self.way[-1] - self.way[self.nodes[-1]])

    def scans(self) -> Scans:
        """Return the features of all keyframes."""
        none = np.empty((0, 5), np.float32)
        rows = [none if view is None else view.features for view in self.views]
        lasers = [np.zeros(2) if view is None else view.laser for view in self.views]
        starts = np.concatenate([[0], np.cumsum([len(r) for r in rows])])
        return Scans(np.concatenate(rows), starts, np.array(lasers))

    def placed_scans(self, poses: Array) -> PlacedScans:
        """Return the scans of all keyframes at poses (k, 3); thinned as their features are."""
        features, starts, lasers = self.scans()
        return PlacedScans(poses, lasers, starts, np.ascontiguousarray(features[:, :2]))


def revised(keys: KeyframeLog, graph: PoseGraph) -> Array:
    """Return the poses (k, 3) of all keyframes: each goes with the node before it."""
    node = keys.node_before
    offset = between(keys.chain[keys.nodes][node], keys.chain)
    return compose(graph.poses[node], offset)


def blended(keys: KeyframeLog, graph: PoseGraph) -> Array:
    """Return the poses (k, 3) of all keyframes: each between the nodes before and after it."""
    if len(keys.nodes) < 2:
        return revised(keys, graph)
    node = np.minimum(keys.node_before, len(keys.nodes) - 2)
    begin, end = keys.way[keys.nodes[node]], keys.way[keys.nodes[node + 1]]
    share = np.clip((keys.way - begin) / (end - begin), 0.0, 1.0)[:, None]
    chain = keys.chain[keys.nodes]
    first = compose(graph.poses[node], between(chain[node], keys.chain))
    second = compose(graph.poses[node + 1], between(chain[node + 1], keys.chain))
    difference = second - first
    difference[:, 2] = wrap(difference[:, 2])
    poses = first + share * difference
    poses[:, 2] = wrap(poses[:, 2])
    return np.asarray(poses)


def refined(poses: Array, keys: KeyframeLog, rounds: int = 2) -> Array:
    """Return poses (k, 3) with all overlapping keyframes laid on each other, in so many rounds.

    They may look any way: a lidar that sees to both sides meets the same walls on a pass there and on
    one back, and pairs that see different ones are found out by their points. Closures are no part of
    it: they rest on the same points, which would count twice.
    """
    i = np.arange(len(poses) - 1)
    motions = between(keys.chain[:-1], keys.chain[1:])
    information = np.asarray(np.linalg.inv(keys.steps[1:]))
    edges = Edges(i, i + 1, motions, information, np.full(len(i), np.inf))
    pairs = overlaps(poses, Nearness(turn=math.pi))
    return refine(poses, keys.scans(), edges, pairs, fit=Fit(rounds=rounds)).poses
