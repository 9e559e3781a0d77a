"""Finds places that the robot has been to before, and adds what they say to the pose graph.

Only where the graph's way back is long has the drift had room to grow, so only there a closure is
sought. It is sought within what the drift may be. The wider the window, the more places look alike;
from a wide one a closure is believed when a second one, found within the next metres, agrees with it
(Mangelson et al. 2018): a false closure is far worse than a missed one.
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
from impslam.recognition.verify import LEAST_MATCHED, Verdict
from impslam.types import Array, Ints

REFERENCE_CELL, QUERY_CELL = 0.05, 0.1  # m: surfels of the map, and points enough to search with
QUERY_REACH = 15.0  # m: farther points are sparse
REFERENCE_REACH = 19.0  # m: what the query can see from the edge of the window
REFERENCE_WAY, REFERENCE_RADIUS = 8.0, 7.0  # m along the graph, and straight: a room around
MOST_REFERENCES = 24  # keyframes; more repeat what these have seen
FEWEST_REFERENCES = 4
AFRESH = 6.0  # m of way: keyframes closer than this along the drive are of the same pass
CERTAIN = 0.8  # m: a window so small holds one place only
SUPPORT = 3  # closures that agree: one strong and another one, or three weak ones
SAME = 1.0, 0.3  # m, rad: places closer than this are one, found twice
IN_A_ROW = 3  # closures that place a session: over some 7 m, corners and furniture differ
RECENT = 12.0  # m of way within which a second closure has to agree


class LoopSearch(Parameters):
    """Where closures are sought."""

    way_back: float = parameter(
        12.0,
        "m",
        "the graph's way back from which a closure is sought: a room and the way out",
        gt=0,
    )
    drift: float = parameter(
        0.04, "m/m", "the pose's drift per way back, with a margin of four", gt=0, le=1
    )
    least: float = parameter(0.4, "m", "added to it: the reach of one alignment", gt=0)
    most: float = parameter(16.0, "m", "the widest window", gt=0)
    turn_drift: float = parameter(0.008, "rad/m", "the heading's drift per way back", gt=0, le=1)
    least_turn: float = parameter(0.06, "rad", "added to it", gt=0)
    most_turn: float = parameter(0.5, "rad", "the widest window", gt=0, le=math.pi)
    attempts: int = parameter(2, "1", "candidates that are tried at each node", ge=0)
    overlap: float = parameter(
        LEAST_MATCHED,
        "1",
        "share of what was seen around a node that was seen before; with less than the default three "
        "closures have to agree",
        ge=0.1,
        le=1,
    )
    around: float = parameter(2.0, "m", "way on either side that a query consists of", gt=0)


class _Pending(NamedTuple):
    """A closure that waits for another one that agrees: between nodes i and j, at `way` m."""

    i: int
    j: int
    closure: Closure
    way: float


class Place(NamedTuple):
    """Where in the map a node may lie: the pose (3,) that is best, and whether it is likely."""

    node: int
    pose: Array
    likely: bool


class _Attempt(NamedTuple):
    """A node that may lie at `guess` (3,) from node u, to which `way` m lead back."""

    u: int
    node: int
    guess: Array
    way: float


class LoopCloser:
    """Seeks closures for one node after the other, among those that the graph connects to it."""

    def __init__(self, search: LoopSearch) -> None:
        self._search, self.recogniser = search, Recogniser(search.overlap)
        self._pending: list[_Pending] = []
        self._ties: list[_Pending] = []

    def seek(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Seek closures of a node, which is not the newest; tell whether the graph says anything new."""
        ways = graph.ways(node)
        windows = np.minimum(self._search.least + self._search.drift * ways, self._search.most)
        apart = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
        possible = (ways > self._search.way_back) & (apart < windows + 2.0) & np.isfinite(ways)
        possible[node:] = False
        possible &= ~graph.is_folded
        if not possible.any():
            return False
        query = self._query(node, keys)
        rank = np.where(possible, apart / (windows + 2.0) + 1e-4 * ways, np.inf)
        driven = keys.way[keys.nodes]
        for _ in range(self._search.attempts):
            u = int(np.argmin(rank))
            if rank[u] == np.inf or query is None:
                return False
            guess = between(graph.poses[u], graph.poses[node])
            closure = self._try(_Attempt(u, node, guess, float(ways[u])), query, keys, graph)
            if closure is not None:
                return self._take(
                    _Pending(u, node, closure, float(driven[node])), graph, windows[u]
                )
            rank[: len(driven)][np.abs(driven - driven[u]) < AFRESH] = np.inf
        return False

    def tie(self, place: Place, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Seek the closure of a node of a session at the place in the map where it may lie.

        Tell whether the session is joined. That takes `IN_A_ROW` of them that agree: where the robot is
        may not be in the map, and other rooms and corridors look like it. A place elsewhere breaks the
        row, and so does one that cannot be verified.
        """
        if not all(_fits(tie, place, graph) for tie in self._ties):
            self._ties = []
        if not place.likely:
            return False
        new = self._tie(place.node, place.pose, keys, graph)
        if new is None or not all(_agree(tie, new, graph) for tie in self._ties):
            self._ties = []
        if new is not None:
            self._ties.append(new)
        if len(self._ties) < IN_A_ROW:
            return False
        for tie in self._ties:
            _add(tie, graph)
        self._ties = []
        return True

    def contradicts(self, node: int, way: float, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Tell whether the map shows something else where a node of a session is by odometry.

        `way` m lead there from the map. Where the map shows nothing, it contradicts nothing.
        """
        apart = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
        apart[graph.roots != 0] = np.inf
        u, query = int(np.argmin(apart)), self._query(node, keys)
        if query is None or apart[u] > 0.5 * REFERENCE_RADIUS:
            return False
        guess = between(graph.poses[u], graph.poses[node])
        return self._try(_Attempt(u, node, guess, way), query, keys, graph) is None

    def _tie(self, node: int, pose: Array, keys: KeyframeLog, graph: PoseGraph) -> _Pending | None:
        """Return the closure of a node with the nearest one in the map, if there is one."""
        apart = np.hypot(*(graph.poses[:, :2] - pose[:2]).T)
        apart[graph.roots != 0] = np.inf
        u, query = int(np.argmin(apart)), self._query(node, keys)
        if query is None or apart[u] > REFERENCE_RADIUS:
            return None
        attempt = _Attempt(u, node, between(graph.poses[u], pose), 0.0)
        closure = self._try(attempt, query, keys, graph)
        if closure is None or closure.verdict != Verdict.STRONG:
            return None
        return _Pending(u, node, closure, float(keys.way[keys.nodes[node]]))

    def _query(self, node: int, keys: KeyframeLog) -> Submap | None:
        """Return what was seen around a node."""
        at = keys.nodes[node]
        near = np.flatnonzero(np.abs(keys.way - keys.way[at]) <= self._search.around)
        return _gathered(near, keys.chain[near], keys.chain[at], keys, (QUERY_CELL, QUERY_REACH))

    def _try(
        self, attempt: _Attempt, query: Submap, keys: KeyframeLog, graph: PoseGraph
    ) -> Closure | None:
        """Return the closure between two nodes, if there is one."""
        s, (u, node, guess, way) = self._search, attempt
        near = graph.ways(u) < REFERENCE_WAY
        near &= np.hypot(*(graph.poses[:, :2] - graph.poses[u, :2]).T) < REFERENCE_RADIUS
        chosen = near[keys.node_before]
        chosen &= keys.way < keys.way[keys.nodes[node]] - AFRESH
        chosen &= keys.seeing
        rows = np.flatnonzero(chosen)
        if len(rows) < FEWEST_REFERENCES:
            return None
        rows = rows[:: max(1, len(rows) // MOST_REFERENCES)]
        poses = revised(keys, graph, rows)
        extent = (REFERENCE_CELL, REFERENCE_REACH)
        reference = _gathered(rows, poses, graph.poses[u], keys, extent)
        if reference is None:
            return None
        radius = min(s.least + s.drift * way, s.most)
        turn = min(s.least_turn + s.turn_drift * way, s.most_turn)
        return self.recogniser.close(reference, query, guess, Window(radius, radius, turn))

    def _take(self, new: _Pending, graph: PoseGraph, window: float) -> bool:
        """Add a closure to the graph, with those that agree with it, or let it wait."""
        if window <= CERTAIN:
            if new.closure.verdict != Verdict.STRONG:
                return False
            return _add(new, graph)
        self._pending = [p for p in self._pending if new.way - p.way <= RECENT]
        agreeing = [p for p in self._pending if _agree(p, new, graph)]
        support = sum(int(p.closure.verdict) for p in (*agreeing, new))
        if not agreeing or support < SUPPORT:
            self._pending.append(new)
            return False
        self._pending = []
        added = [_add(p, graph) for p in (*agreeing, new)]
        return any(added)


def _gathered(
    rows: Ints, poses: Array, frame: Array, keys: KeyframeLog, extent: tuple[float, float]
) -> Submap | None:
    """Return the keyframes of some rows as one submap; None where none of them saw anything."""
    seen = [k for k, row in enumerate(rows) if keys.views[row] is not None]
    views = [view for row in rows if (view := keys.views[row]) is not None]
    return gather(views, poses[seen], frame, *extent) if views else None


def _agree(one: _Pending, other: _Pending, graph: PoseGraph) -> bool:
    """Tell whether two closures are consistent; what lies between their ends drifts little."""
    way = abs(other.way - one.way)
    drift = np.diag([(0.05 + 0.01 * way) ** 2, (0.05 + 0.01 * way) ** 2, (0.01 + 0.002 * way) ** 2])
    references = Relation(between(graph.poses[one.i], graph.poses[other.i]), drift)
    queries = Relation(between(graph.poses[one.j], graph.poses[other.j]), drift)
    return consistent(_relation(one), _relation(other), references, queries)


def _fits(tie: _Pending, place: Place, graph: PoseGraph) -> bool:
    """Tell whether a place is where a closure of the same session has it, about."""
    at = compose(graph.poses[tie.i], tie.closure.pose)
    expected = compose(at, between(graph.poses[tie.j], graph.poses[place.node]))
    d = between(expected, place.pose)
    return bool(math.hypot(d[0], d[1]) < SAME[0] and abs(d[2]) < SAME[1])


def _relation(found: _Pending) -> Relation:
    return Relation(found.closure.pose, np.asarray(np.linalg.inv(found.closure.information)))


def _add(found: _Pending, graph: PoseGraph) -> bool:
    return graph.close(found.i, found.j, found.closure.pose, found.closure.information)
