"""Find revisited places, and add loop closures to the pose graph.

Drift grows with distance, so closures are only searched between nodes with a long path through the graph,
in a window of the size of the possible drift. A wide window contains more similar places, and a false
closure is far worse than a missed one: a closure from a wide window is accepted only when others, found
within the next metres, are consistent with it (Mangelson et al. 2018). More of them are required if the
pose is so uncertain that the true place may be outside of the widest window.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.errors import NumericalError
from impslam.estimators.keyframe_log import KeyframeLog, revised
from impslam.estimators.pose_graph import CLOSURE_LENGTH, PoseGraph
from impslam.geometry.covariances import inverse_of
from impslam.geometry.se2 import between
from impslam.noise import UNKNOWN
from impslam.parameters import Parameters, parameter
from impslam.recognition.consistency import Relation, consistent
from impslam.recognition.correlative import Window
from impslam.recognition.places import Closure, Recogniser
from impslam.recognition.submap import Submap, gather
from impslam.recognition.verify import MIN_MATCHED, STRONG_SHARE, ClosureStrength
from impslam.types import Array, Ints

REFERENCE_CELL, QUERY_CELL = 0.05, 0.1  # m: surfels of the map, and enough points for a search
QUERY_RANGE = 15.0  # m: farther points are sparse
REFERENCE_RANGE = 19.0  # m: visible to the query from the edge of the window
REFERENCE_DISTANCE, REFERENCE_RADIUS = 8.0, 7.0  # m along the graph, and straight: about a room
MAX_REFERENCES = 24  # keyframes; more are redundant
MIN_REFERENCES = 4
PASS_DISTANCE = 6.0  # m: keyframes closer than this along the drive are of the same pass
SAFE_WINDOW = 0.8  # m: so small a window contains only one place
MIN_EVIDENCE = 2.5
"""Evidence of closures that agree: a strong and another one, three weak ones or ones without a position, or
two that together have 1.25 times the common area of a strong one."""
WIDE_VIEW = 0.5
"""Share of all directions that the scans of a strong closure see: half, like a lidar of 180 deg. In a depth
camera's 57 deg, many rooms look alike."""
MAX_REACH, MIN_DISTANT_EVIDENCE = 16.0, 4.5
"""m, 3 sigma, by which the node may be off, and the same beyond: the true place may then be elsewhere, and
look like the one found. Three strong closures are needed, or two and a weak one. In 3 of 10 simulated
drives through a convention centre, with a lidar of 4 m range, two were 11 m off."""
CONFIRMATION_DISTANCE = 12.0  # m driven within which a second closure has to agree
MAX_KNOWN_WINDOW = 3.0  # m: a node whose window is no wider should be where the graph has it,
KNOWN_DISTANCE = 0.5 * REFERENCE_RADIUS  # m: if another node is so near
MIN_CONTRADICTED = 0.1
"""Share of the points of a node or of its reference in the free space of the other, in excess of those in
its own, at which they contradict each other, unless a strong closure joins them. In the failed searches of
three recorded buildings it is at most 0.02, in simulations of an office with 50 chairs and of a hall with
20 people at most 0.05, and 0.11 to 0.5 for carried robots."""
MIN_CONTRADICTIONS = 3  # nodes in a row: 7 m of driving
CLOSE_BY = 2.0
"""m beyond its window up to which a candidate is tried: other scans of its submap may be inside."""
DRIFT, MIN_DRIFT = (0.01, 0.002), (0.05, 0.01)
"""Standard deviations of the drift between two closures that have to agree: m and rad per m driven, and m
and rad over any distance. They are a quarter of the margins in `LoopSearch`."""


class LoopSearch(Parameters):
    """Where to search for closures."""

    min_path: float = parameter(
        12.0,
        "m",
        "minimum path length through the graph to a candidate: a room and the way out",
        gt=0,
    )
    drift: float = parameter(
        0.04, "m/m", "drift of the position per path length, with a margin of four", gt=0, le=1
    )
    min_window: float = parameter(
        0.4, "m", "window without drift: the convergence radius of one alignment", gt=0
    )
    max_window: float = parameter(32.0, "m", "maximum window", gt=0)
    turn_drift: float = parameter(
        0.008, "rad/m", "drift of the heading per path length", gt=0, le=1
    )
    min_turn_window: float = parameter(0.06, "rad", "heading window without drift", gt=0)
    max_turn_window: float = parameter(0.5, "rad", "maximum heading window", gt=0, le=math.pi)
    candidates: int = parameter(
        2,
        "1",
        "number of candidates tried at each node, more in wide windows; 0: no loop closures",
        ge=0,
    )
    overlap: float = parameter(
        MIN_MATCHED,
        "1",
        "minimum share of the points around a node that match earlier ones; the smaller it is, the more "
        "closures have to agree",
        ge=0.1,
        le=1,
    )
    query_distance: float = parameter(
        2.0, "m", "distance driven before and after a node that a query covers", gt=0
    )


class PendingClosure(NamedTuple):
    """A closure that awaits confirmation.

    Attributes
    ----------
    i, j : nodes
    closure : between them
    distance : m driven to node j
    view_share : mean share of all directions that a scan around node j sees
    """

    i: int
    j: int
    closure: Closure
    distance: float
    view_share: float

    @property
    def is_strong(self) -> bool:
        """Whether it needs no others that agree."""
        return self.closure.verdict == ClosureStrength.STRONG

    @property
    def evidence(self) -> float:
        """What it contributes to `MIN_EVIDENCE`: 2 if strong, less in a small area or view, at least 1.

        One without a position shows little more than a wall, and a parallel one looks alike.
        """
        support = self.closure.support
        if support.agreement < STRONG_SHARE or not self.closure.has_position:
            return 1.0
        return max(1.0, 2.0 * min(1.0, support.size, self.view_share / WIDE_VIEW))


class Comparison(NamedTuple):
    """A node of a pending session, compared with the map at a pose.

    Attributes
    ----------
    offset : m to the nearest node of the map; inf if nothing can be compared
    closure : of the two, if there is one
    """

    offset: float
    closure: PendingClosure | None

    @property
    def contradicts(self) -> bool:
        """Whether the node is not at that pose. Unknown areas of the map contradict nothing."""
        return self.closure is None and self.offset < KNOWN_DISTANCE


class LoopCloser:
    """Searches closures for one node after the other, among the nodes connected to it.

    Attributes
    ----------
    contradicted : the newest nodes, in a row, that what was seen there earlier contradicts
    doubtful : the node from which on the robot may be elsewhere if there are such nodes
    """

    def __init__(self, search: LoopSearch) -> None:
        self._search, self.recogniser = search, Recogniser(search.overlap)
        self._pending: list[PendingClosure] = []
        self.contradicted: list[int] = []
        self.doubtful = self._unconfirmed = 0

    def copy(self) -> LoopCloser:
        """Return one that continues the search on a copy of the graph."""
        other = LoopCloser(self._search)
        other._pending, other.contradicted = list(self._pending), list(self.contradicted)
        other.doubtful, other._unconfirmed = self.doubtful, self._unconfirmed
        other.recogniser.counts.update(self.recogniser.counts)
        return other

    def search(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Search closures of a node; return whether the graph must be solved.

        What is driven after the node belongs to the query, so the newest node waits for the next one. A
        weak closure only counts if there is no strong one with another candidate.
        """
        paths = graph.path_lengths(node)
        candidates = self._candidates(node, paths, keys, graph)
        if not candidates or (query := self._query(node, keys)) is None:
            return False
        weak: PendingClosure | None = None
        for u in candidates:
            if (reference := self._reference(u, node, keys, graph)) is None:
                continue
            guess, window = between(graph.poses[u], graph.poses[node]), self.window(float(paths[u]))
            closure = self.recogniser.find_closure(reference, query, guess, window)
            is_known = window.x <= MAX_KNOWN_WINDOW and math.hypot(*guess[:2]) < KNOWN_DISTANCE
            contradicts = is_known and self._contradicts(reference, query, guess, closure)
            if contradicts:
                closure = None
            if u == candidates[0]:
                self._note(node, contradicts, closure)
            if closure is None:
                continue
            driven = float(keys.distance[keys.nodes[node]])
            new = PendingClosure(u, node, closure, driven, query.view_share)
            if new.is_strong:
                return self._accept(new, graph, window.x)
            weak = weak or new
        return weak is not None and self._accept(weak, graph, float(self._radius(paths[weak.i])))

    def _candidates(
        self, node: int, paths: Array, keys: KeyframeLog, graph: PoseGraph
    ) -> list[int]:
        """Return the nodes to compare with a node, the nearest relative to its window first.

        `paths` (n,) m are the path lengths to all nodes. Each candidate covers only a part of a wide
        window, so more are tried there.
        """
        search, windows = self._search, self._radius(paths)
        offsets = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
        possible = (paths > search.min_path) & (offsets < windows + CLOSE_BY) & np.isfinite(paths)
        possible[node:] = False
        possible &= ~graph.is_folded
        # Of places at the same offset, the pass with the shorter path is the more certain one.
        rank = np.where(possible, offsets / (windows + CLOSE_BY) + 1e-4 * paths, np.inf)
        driven = keys.distance[keys.nodes]
        chosen: list[int] = []
        wide = int(windows[np.argmin(rank)] / REFERENCE_RADIUS)
        while len(chosen) < search.candidates * max(1, wide) and np.isfinite(rank).any():
            u = int(np.argmin(rank))
            chosen.append(u)
            rank[np.abs(driven - driven[u]) < PASS_DISTANCE] = np.inf
        return chosen

    def _note(self, node: int, contradicts: bool, closure: Closure | None) -> None:
        """Note whether the map contradicts a node.

        The query of the node before the first such one may contain scans from two places. Then it
        contradicts itself, which says nothing about the map, but it has no closure either.
        """
        if not contradicts:
            self.contradicted = []
            self._unconfirmed = node if closure is None else 0
            return
        if not self.contradicted:
            self.doubtful = node - 1 if self._unconfirmed == node - 1 else node
        self.contradicted.append(node)

    def _contradicts(
        self, reference: Submap, query: Submap, guess: Array, closure: Closure | None
    ) -> bool:
        """Return whether a reference contradicts a query that it should contain."""
        if closure is not None and closure.verdict == ClosureStrength.STRONG:
            return False
        pose = guess if closure is None else closure.pose
        return self.recogniser.contradiction(reference, query, pose) >= MIN_CONTRADICTED

    def compare(
        self, node: int, pose: Array, window: Window, keys: KeyframeLog, graph: PoseGraph
    ) -> Comparison:
        """Compare a node of a pending session with the map in a window around a pose (3,)."""
        offsets = np.hypot(*(graph.poses[:, :2] - pose[:2]).T)
        offsets[graph.roots != 0] = np.inf
        u, query = int(np.argmin(offsets)), self._query(node, keys)
        if query is None or offsets[u] > REFERENCE_RADIUS:
            return Comparison(math.inf, None)
        if (reference := self._reference(u, node, keys, graph)) is None:
            return Comparison(math.inf, None)
        guess = between(graph.poses[u], pose)
        closure = self.recogniser.find_closure(reference, query, guess, window)
        if closure is None:
            differs = self.recogniser.outcome in ("no peak", "contradicted")
            return Comparison(float(offsets[u]) if differs else math.inf, None)
        driven = float(keys.distance[keys.nodes[node]])
        return Comparison(
            float(offsets[u]), PendingClosure(u, node, closure, driven, query.view_share)
        )

    def _query(self, node: int, keys: KeyframeLog) -> Submap | None:
        """Return the scans around a node as a submap."""
        row = keys.nodes[node]
        near = np.flatnonzero(
            np.abs(keys.distance - keys.distance[row]) <= self._search.query_distance
        )
        return _submap(near, keys.chain[near], keys.chain[row], keys, (QUERY_CELL, QUERY_RANGE))

    def _reference(self, u: int, node: int, keys: KeyframeLog, graph: PoseGraph) -> Submap | None:
        """Return what was seen around node u before another one as a submap, if it was seen enough."""
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
        return _submap(rows, poses, graph.poses[u], keys, (REFERENCE_CELL, REFERENCE_RANGE))

    def window(self, distance: float) -> Window:
        """Return the window of the possible drift over a distance in m."""
        s, radius = self._search, float(self._radius(np.array(distance)))
        return Window(
            radius, radius, min(s.min_turn_window + s.turn_drift * distance, s.max_turn_window)
        )

    def _radius(self, distances: Array) -> Array:
        """Return the possible drift in m over distances in m."""
        s = self._search
        return np.asarray(np.minimum(s.min_window + s.drift * distances, s.max_window))

    def length(self, radius: float) -> float:
        """Return the distance in m over which the possible drift is `radius` m."""
        return max(radius - self._search.min_window, 0.0) / self._search.drift

    def _accept(self, new: PendingClosure, graph: PoseGraph, window: float) -> bool:
        """Add a closure and those that agree with it to the graph, or keep it pending."""
        if window <= SAFE_WINDOW:
            return new.is_strong and add_to_graph(new, graph)
        self._pending = [
            p for p in self._pending if new.distance - p.distance <= CONFIRMATION_DISTANCE
        ]
        agreeing = [
            p
            for p in self._pending
            if p.closure.has_position == new.closure.has_position and closures_agree(p, new, graph)
        ]
        evidence = sum(p.evidence for p in (*agreeing, new))
        if not agreeing or evidence < self._min_evidence(new, graph):
            self._pending.append(new)
            return False
        self._pending = []
        added = [add_to_graph(p, graph) for p in (*agreeing, new)]
        return any(added)

    def _min_evidence(self, new: PendingClosure, graph: PoseGraph) -> float:
        """Return the evidence required of a closure and those that agree with it."""
        try:
            reach = float(graph.reach(new.j)[new.i])
        except NumericalError:
            reach = math.inf
        return MIN_EVIDENCE if reach <= MAX_REACH else MIN_DISTANT_EVIDENCE


def _submap(
    rows: Ints, poses: Array, frame: Array, keys: KeyframeLog, extent: tuple[float, float]
) -> Submap | None:
    """Return the keyframes of some rows as one submap; None if none of them has a view."""
    seen = [k for k, row in enumerate(rows) if keys.views[row] is not None]
    views = [view for row in rows if (view := keys.views[row]) is not None]
    return gather(views, poses[seen], frame, *extent) if views else None


def closures_agree(one: PendingClosure, other: PendingClosure, graph: PoseGraph) -> bool:
    """Return whether two closures are consistent, up to the drift between their ends."""
    distance = abs(other.distance - one.distance)
    position, heading = np.array(MIN_DRIFT) + np.array(DRIFT) * distance
    drift = np.diag([position**2, position**2, heading**2])
    references = Relation(between(graph.poses[one.i], graph.poses[other.i]), drift)
    queries = Relation(between(graph.poses[one.j], graph.poses[other.j]), drift)
    return consistent(_relation(one), _relation(other), references, queries)


def _relation(pending: PendingClosure) -> Relation:
    information = pending.closure.information + np.eye(3) / UNKNOWN  # 0 along a corridor
    return Relation(pending.closure.pose, inverse_of(information))


def add_to_graph(pending: PendingClosure, graph: PoseGraph) -> bool:
    """Add a closure to the graph; return whether it must be solved.

    One without a position does not limit the drift along the corridor, so it shortens no path.
    """
    i, j, found = pending.i, pending.j, pending.closure
    length = CLOSURE_LENGTH if found.has_position else math.inf
    return graph.add_closure(i, j, found.pose, found.information, length)
