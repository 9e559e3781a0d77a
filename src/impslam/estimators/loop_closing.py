"""Find places that the robot has been to before, and add loop closures to the pose graph.

Drift grows with distance, so closures are only searched between nodes with a long path through the graph,
in a window of the size of the possible drift. The wider the window, the more similar places it contains: a
closure from a wide one is accepted when a second one, found within the next metres, is consistent with it
(Mangelson et al. 2018), because a false closure is far worse than a missed one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.estimators.keyframe_log import KeyframeLog, revised
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.se2 import between, compose
from impslam.parameters import Parameters, parameter
from impslam.recognition.consistency import Relation, consistent
from impslam.recognition.correlative import Window
from impslam.recognition.places import Closure, Recogniser
from impslam.recognition.submap import Submap, gather
from impslam.recognition.verify import MIN_MATCHED, ClosureStrength
from impslam.types import Array, Ints

REFERENCE_CELL, QUERY_CELL = 0.05, 0.1  # m: surfels of the map, and enough points for a search
QUERY_RANGE = 15.0  # m: farther points are sparse
REFERENCE_RANGE = 19.0  # m: visible to the query from the edge of the window
REFERENCE_DISTANCE, REFERENCE_RADIUS = 8.0, 7.0  # m along the graph, and straight: about a room
MAX_REFERENCES = 24  # keyframes; more are redundant
MIN_REFERENCES = 4
PASS_DISTANCE = 6.0  # m: keyframes closer than this along the drive are of the same pass
SAFE_WINDOW = 0.8  # m: so small a window contains only one place
MIN_SUPPORT = 3  # sum of verdicts that agree: a strong and another one, or three weak ones
SAME_PLACE = 1.0, 0.3  # m, rad: closer places are the same
MIN_TIES = 3  # closures that place a session: over some 7 m, corners and furniture differ
CONFIRMATION_DISTANCE = 12.0  # m driven within which a second closure has to agree


class LoopSearch(Parameters):
    """Where to search for closures."""

    way_back: float = parameter(
        12.0,
        "m",
        "shortest path through the graph to a candidate: a room and the way out",
        gt=0,
    )
    drift: float = parameter(
        0.04, "m/m", "the pose's drift per path length, with a margin of four", gt=0, le=1
    )
    least: float = parameter(0.4, "m", "added to it: the convergence radius of one alignment", gt=0)
    most: float = parameter(16.0, "m", "the widest window", gt=0)
    turn_drift: float = parameter(0.008, "rad/m", "the heading's drift per path length", gt=0, le=1)
    least_turn: float = parameter(0.06, "rad", "added to it", gt=0)
    most_turn: float = parameter(0.5, "rad", "the widest window", gt=0, le=math.pi)
    attempts: int = parameter(2, "1", "candidates that are tried at each node", ge=0)
    overlap: float = parameter(
        MIN_MATCHED,
        "1",
        "share of the points around a node that match earlier ones; with less than the default, three "
        "closures have to agree",
        ge=0.1,
        le=1,
    )
    around: float = parameter(
        2.0, "m", "distance driven before and after a node that a query covers", gt=0
    )


class _Pending(NamedTuple):
    """A closure between nodes i and j that awaits confirmation, found after `distance` m."""

    i: int
    j: int
    closure: Closure
    distance: float


class Place(NamedTuple):
    """A possible place of a node in the map.

    Attributes
    ----------
    node : the node
    pose : (3,) the best pose
    likely : whether it is likely, among the places found
    hinted : whether a user gave the area
    """

    node: int
    pose: Array
    likely: bool
    hinted: bool


class _Attempt(NamedTuple):
    """A node that may be at `guess` (3,) relative to node u, `distance` m away along the graph."""

    u: int
    node: int
    guess: Array
    distance: float


class LoopCloser:
    """Searches closures for one node after the other, among the nodes connected to it."""

    def __init__(self, search: LoopSearch) -> None:
        self._search, self.recogniser = search, Recogniser(search.overlap)
        self._pending: list[_Pending] = []
        self._ties: list[_Pending] = []

    def copy(self) -> LoopCloser:
        """Return one that continues the search on a copy of the graph."""
        other = LoopCloser(self._search)
        other._pending = list(self._pending)
        return other

    def search(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Search closures of a node; return whether the graph must be solved.

        What is driven after the node belongs to the query, so the newest node waits for the next one.
        """
        paths = graph.path_lengths(node)
        windows = np.minimum(self._search.least + self._search.drift * paths, self._search.most)
        offsets = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
        possible = (paths > self._search.way_back) & (offsets < windows + 2.0) & np.isfinite(paths)
        possible[node:] = False
        possible &= ~graph.is_folded
        if not possible.any():
            return False
        query = self._query(node, keys)
        rank = np.where(possible, offsets / (windows + 2.0) + 1e-4 * paths, np.inf)
        driven = keys.distance[keys.nodes]
        for _ in range(self._search.attempts):
            u = int(np.argmin(rank))
            if rank[u] == np.inf or query is None:
                return False
            guess = between(graph.poses[u], graph.poses[node])
            closure = self._try(_Attempt(u, node, guess, float(paths[u])), query, keys, graph)
            if closure is not None:
                return self._accept(
                    _Pending(u, node, closure, float(driven[node])), graph, windows[u]
                )
            rank[: len(driven)][np.abs(driven - driven[u]) < PASS_DISTANCE] = np.inf
        return False

    def tie(self, place: Place, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Search the closure of a node of a pending session at a possible place in the map.

        Return whether the session is joined. That takes `MIN_TIES` consecutive closures that agree: the
        robot may be outside the map, where other rooms and corridors look similar. A place elsewhere, or
        one that cannot be verified, starts the count again. In an area that a user gave, one is enough.
        """
        if not all(_is_consistent(tie, place, graph) for tie in self._ties):
            self._ties = []
        if not place.likely:
            return False
        new = self._tie(place.node, place.pose, keys, graph)
        if new is None or not all(_agree(tie, new, graph) for tie in self._ties):
            self._ties = []
        if new is not None:
            self._ties.append(new)
        if len(self._ties) < (1 if place.hinted else MIN_TIES):
            return False
        for tie in self._ties:
            _add(tie, graph)
        self._ties = []
        return True

    def contradicts(self, node: int, distance: float, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Return whether the map contradicts the scans of a session's node at its pose by odometry.

        The node is `distance` m from the map. Unknown areas of the map contradict nothing.
        """
        offsets = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
        offsets[graph.roots != 0] = np.inf
        u, query = int(np.argmin(offsets)), self._query(node, keys)
        if query is None or offsets[u] > 0.5 * REFERENCE_RADIUS:
            return False
        guess = between(graph.poses[u], graph.poses[node])
        return self._try(_Attempt(u, node, guess, distance), query, keys, graph) is None

    def _tie(self, node: int, pose: Array, keys: KeyframeLog, graph: PoseGraph) -> _Pending | None:
        """Return the closure of a node with the nearest one in the map, if there is one."""
        offsets = np.hypot(*(graph.poses[:, :2] - pose[:2]).T)
        offsets[graph.roots != 0] = np.inf
        u, query = int(np.argmin(offsets)), self._query(node, keys)
        if query is None or offsets[u] > REFERENCE_RADIUS:
            return None
        attempt = _Attempt(u, node, between(graph.poses[u], pose), 0.0)
        closure = self._try(attempt, query, keys, graph)
        if closure is None or closure.verdict != ClosureStrength.STRONG:
            return None
        return _Pending(u, node, closure, float(keys.distance[keys.nodes[node]]))

    def _query(self, node: int, keys: KeyframeLog) -> Submap | None:
        """Return the scans around a node as a submap."""
        row = keys.nodes[node]
        near = np.flatnonzero(np.abs(keys.distance - keys.distance[row]) <= self._search.around)
        return _submap(near, keys.chain[near], keys.chain[row], keys, (QUERY_CELL, QUERY_RANGE))

    def _try(
        self, attempt: _Attempt, query: Submap, keys: KeyframeLog, graph: PoseGraph
    ) -> Closure | None:
        """Return the closure between two nodes, if there is one."""
        s, (u, node, guess, distance) = self._search, attempt
        near = graph.path_lengths(u) < REFERENCE_DISTANCE
        near &= np.hypot(*(graph.poses[:, :2] - graph.poses[u, :2]).T) < REFERENCE_RADIUS
        chosen = near[keys.node_before]
        chosen &= keys.distance < keys.distance[keys.nodes[node]] - PASS_DISTANCE
        chosen &= keys.has_view
        rows = np.flatnonzero(chosen)
        if len(rows) < MIN_REFERENCES:
            return None
        rows = rows[:: max(1, len(rows) // MAX_REFERENCES)]
        poses = revised(keys, graph, rows)
        extent = (REFERENCE_CELL, REFERENCE_RANGE)
        reference = _submap(rows, poses, graph.poses[u], keys, extent)
        if reference is None:
            return None
        radius = min(s.least + s.drift * distance, s.most)
        turn = min(s.least_turn + s.turn_drift * distance, s.most_turn)
        return self.recogniser.close(reference, query, guess, Window(radius, radius, turn))

    def _accept(self, new: _Pending, graph: PoseGraph, window: float) -> bool:
        """Add a closure and those that agree with it to the graph, or keep it pending."""
        if window <= SAFE_WINDOW:
            if new.closure.verdict != ClosureStrength.STRONG:
                return False
            return _add(new, graph)
        self._pending = [
            p for p in self._pending if new.distance - p.distance <= CONFIRMATION_DISTANCE
        ]
        agreeing = [p for p in self._pending if _agree(p, new, graph)]
        support = sum(int(p.closure.verdict) for p in (*agreeing, new))
        if not agreeing or support < MIN_SUPPORT:
            self._pending.append(new)
            return False
        self._pending = []
        added = [_add(p, graph) for p in (*agreeing, new)]
        return any(added)


def _submap(
    rows: Ints, poses: Array, frame: Array, keys: KeyframeLog, extent: tuple[float, float]
) -> Submap | None:
    """Return the keyframes of some rows as one submap; None if none of them has a view."""
    seen = [k for k, row in enumerate(rows) if keys.views[row] is not None]
    views = [view for row in rows if (view := keys.views[row]) is not None]
    return gather(views, poses[seen], frame, *extent) if views else None


def _agree(one: _Pending, other: _Pending, graph: PoseGraph) -> bool:
    """Return whether two closures are consistent, up to the drift between their ends."""
    distance = abs(other.distance - one.distance)
    sigma, turn_sigma = 0.05 + 0.01 * distance, 0.01 + 0.002 * distance
    drift = np.diag([sigma**2, sigma**2, turn_sigma**2])
    references = Relation(between(graph.poses[one.i], graph.poses[other.i]), drift)
    queries = Relation(between(graph.poses[one.j], graph.poses[other.j]), drift)
    return consistent(_relation(one), _relation(other), references, queries)


def _is_consistent(tie: _Pending, place: Place, graph: PoseGraph) -> bool:
    """Return whether a place is consistent with a closure of the same session."""
    tied = compose(graph.poses[tie.i], tie.closure.pose)
    expected = compose(tied, between(graph.poses[tie.j], graph.poses[place.node]))
    d = between(expected, place.pose)
    return bool(math.hypot(d[0], d[1]) < SAME_PLACE[0] and abs(d[2]) < SAME_PLACE[1])


def _relation(pending: _Pending) -> Relation:
    return Relation(pending.closure.pose, np.asarray(np.linalg.inv(pending.closure.information)))


def _add(pending: _Pending, graph: PoseGraph) -> bool:
    return graph.close(pending.i, pending.j, pending.closure.pose, pending.closure.information)
