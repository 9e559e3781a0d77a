"""Place pending sessions, which no edge connects to the map yet.

A session begins where a map is continued, and where scans stop fitting the map. Then either the robot was
carried, or only its view has changed and odometry is still right. The scans of the session's nodes are
compared with the map in both cases: wherever they are found in the whole map, and where odometry expects
them. The place by odometry needs fewer closures that agree, and another one is not accepted while the map
agrees with odometry.
"""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

import numpy as np

from impslam.estimators.keyframe_log import KeyframeLog
from impslam.estimators.loop_closing import (
    MIN_CONTRADICTIONS,
    Comparison,
    LoopCloser,
    PendingClosure,
    add_to_graph,
    closures_agree,
)
from impslam.estimators.pose_graph import PoseGraph
from impslam.estimators.session_finder import Guess, SessionFinder
from impslam.geometry.covariances import inverse_of
from impslam.geometry.se2 import between, compose, compose_uncertain, inverse
from impslam.recognition.beams import MAX_MISFIT
from impslam.recognition.consistency import Relation, consistent
from impslam.recognition.correlative import Window
from impslam.types import Array

SAME_PLACE = 1.0, 0.3  # m, rad: closer places are the same
MIN_CLOSURES = 3  # that place a session: over some 7 m, corners and furniture differ
MIN_EXPECTED_CLOSURES = 2  # at the place by odometry: a carried robot is seldom at a similar one
MIN_SURPRISING_CLOSURES = 6  # elsewhere, although the map does not contradict odometry
MAX_SIGMA = 0.1  # m: along a bare corridor, scans agree with any place
BREAK_DRIFT = 0.3
"""m/m and rad of drift after a break: scans are matched with the first ones of a session, which may show
little but the crowd that covered the lidar."""
BREAK_LENGTH = 40.0  # m whose drift is as large: loops are searched for in windows that are so wide
MAX_FRUITLESS, FRUITLESS_STEP = 20, 4
"""Nodes (50 m) without a likely place after which the whole map is searched at every fourth node only,
until a place is likely: in a large map, a search takes seconds."""
MIN_SEARCH_DISTANCE = 20.0
"""m driven before an unlocated session may be joined by odometry: six times the length of a query."""


class _Break(NamedTuple):
    """A place where scans stopped fitting: the first node after it, and odometry's motion (3,) to it."""

    node: int
    motion: Array
    covariance: Array

    @property
    def radius(self) -> float:
        """Three standard deviations of the position after it, m."""
        return 3.0 * math.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[-1])


class SessionPlacer:
    """Places one pending session after the other; `hint` is the approximate start of the first one."""

    def __init__(self, closer: LoopCloser, hint: Array | None = None) -> None:
        self._closer, self._finder = closer, SessionFinder(hint)
        self._breaks: list[_Break] = []
        self._compared: list[Comparison] = []  # at the places by odometry, since the last break
        self._closures: list[PendingClosure] = []
        self._fruitless = 0  # nodes of the newest session since a place was likely
        self._assumed: int | None = None
        self._is_contradicted = False  # the map contradicts the place by odometry

    def copy(self) -> SessionPlacer:
        """Return a copy with the state of this moment; both use the same closer and finder."""
        other = copy(self)
        other._breaks, other._compared = self._breaks.copy(), self._compared.copy()
        other._closures = self._closures.copy()
        return other

    @property
    def is_assumed(self) -> bool:
        """Whether nodes are placed by odometry alone, and no earlier place is recognised since."""
        return self._assumed is not None

    @property
    def _is_vague(self) -> bool:
        """Whether odometry does not tell the place to `SAME_PLACE`; scans may fit a similar one there."""
        return any(gap.radius >= SAME_PLACE[0] for gap in self._breaks)

    def begin(self, node: int, motion: tuple[Array, Array] | None) -> None:
        """Begin a session at a node.

        `motion` is odometry's from the node before, (3,) with its covariance (3, 3), if there is any.
        """
        self._compared, self._closures, self._is_contradicted = [], [], False
        self._fruitless = 0
        if motion is not None:
            self._breaks.append(_Break(node, *motion))

    def separate(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Make the nodes from one on a pending session, if they can be; return whether they are."""
        if graph.roots[node] != 0 or (motion := graph.cut(node)) is None:
            return False
        keys.begin_session(int(keys.nodes[node]))
        self.begin(node, motion)
        self._is_contradicted = True
        return True

    def place(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Try to place the newest session by one of its nodes; return whether it is joined to the map."""
        if graph.roots[node] == 0 or graph.roots[node] != graph.roots[-1]:
            return False
        if self._is_recognised(node, keys, graph):
            for closure in self._closures:
                add_to_graph(closure, graph)
            self._join_breaks(graph)
            return True
        if not self._may_assume_odometry(node, keys):
            return False
        first = self._breaks[0].node
        self._join_breaks(graph)
        if graph.roots[node] != 0:
            return False
        self._assumed = first if self._assumed is None else self._assumed
        return True

    def confirm(self, new: int, graph: PoseGraph) -> None:
        """Consider the newest closures: one with a node from before the break confirms odometry."""
        edges = graph.edges
        ends = np.minimum(edges.i, edges.j)[len(edges.i) - new :]
        if self._assumed is not None and (ends < self._assumed).any():
            self._assumed = None

    def _is_recognised(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Return whether the closures of the last nodes, with that of this one, place the session.

        A place elsewhere, or a likely one that cannot be verified, starts the count again. In an area that
        a user gave, one closure is enough.
        """
        guess = self._search(node, keys, graph)
        comparison = self._compare_odometry(node, keys, graph)
        expected = None if self._is_vague else _distinct_closure(comparison)
        if guess is not None and expected is not None:
            expected = self._nearer(node, guess.pose, expected, keys, graph)
        new = expected
        if guess is not None and guess.likely:
            new = self._verified(node, guess.pose, expected, keys, graph)
        if new is None:
            if guess is not None and (guess.likely or not self._is_at(guess.pose, node, graph)):
                self._closures = []
            return False
        if not all(closures_agree(closure, new, graph) for closure in self._closures):
            self._closures = []
        self._closures.append(new)
        if guess is not None and guess.hinted:
            return True
        required = MIN_EXPECTED_CLOSURES if new is expected else self._required()
        if len(self._closures) < required:
            return False
        if self._is_refuted(node, keys, graph):
            self._closures = []
        return bool(self._closures)

    def _search(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> Guess | None:
        """Search the whole map for a node; see `MAX_FRUITLESS` for the nodes that are left out."""
        self._fruitless += 1
        if self._fruitless > MAX_FRUITLESS and self._fruitless % FRUITLESS_STEP:
            return None
        guess = self._finder.find(node, keys, graph)
        if guess is not None and guess.likely:
            self._fruitless = 0
        return guess

    def _is_refuted(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> bool:
        """Return whether the drive so far does not fit the map at the place of the newest closure.

        The longer a robot drives on another floor, the likelier are some places in a row that look alike.
        Where odometry connects the session to the map, what covered the lidar would count as well.
        """
        if self._is_linked(int(graph.roots[node]), graph):
            return False
        row, pose = int(keys.nodes[node]), _placed(self._closures[-1], graph)
        return self._finder.misfit(row, pose, keys) > MAX_MISFIT

    def _verified(
        self,
        node: int,
        pose: Array,
        expected: PendingClosure | None,
        keys: KeyframeLog,
        graph: PoseGraph,
    ) -> PendingClosure | None:
        """Return the closure at a likely pose (3,), or `expected` if it is where odometry leads to.

        None if the map agrees with odometry elsewhere, but not within its errors: the window around it, of
        some metres, may contain a place that looks like the one of the robot.
        """
        if expected is not None:
            is_same = _is_same_place(_placed(expected, graph), pose)
            return expected if is_same or self._agrees_with_odometry(expected, graph) else None
        closure = self._closer.compare(node, pose, self._closer.window(0.0), keys, graph).closure
        if closure is None or not (closure.is_strong and closure.closure.has_position):
            return None
        return closure

    def _agrees_with_odometry(self, closure: PendingClosure, graph: PoseGraph) -> bool:
        """Return whether a closure is where odometry, within its errors across the breaks, leads to."""
        poses, at, exact = graph.poses, closure.i, np.zeros((3, 3))
        still = Relation(np.zeros(3), exact)
        odometry = still
        for gap in self._breaks:
            before = compose_uncertain(*odometry, between(poses[at], poses[gap.node - 1]), exact)
            odometry = Relation(*compose_uncertain(*before, gap.motion, gap.covariance))
            at = gap.node
        after = between(poses[at], poses[closure.j])
        found = Relation(closure.closure.pose, inverse_of(closure.closure.information))
        return consistent(found, odometry, still, still._replace(pose=inverse(after)))

    def _nearer(
        self,
        node: int,
        pose: Array,
        expected: PendingClosure,
        keys: KeyframeLog,
        graph: PoseGraph,
    ) -> PendingClosure | None:
        """Return the closure at a guessed pose (3,) if that is nearer to odometry's than `expected` is.

        After some metres, the window around odometry's place contains several places that look the same.
        """
        odometry, found = graph.poses[node], _placed(expected, graph)
        if _is_same_place(found, pose) or _distance(odometry, found) < _distance(odometry, pose):
            return expected
        window = self._closer.window(0.0)
        return _distinct_closure(self._closer.compare(node, pose, window, keys, graph))

    def _is_at(self, pose: Array, node: int, graph: PoseGraph) -> bool:
        """Return whether a pose (3,) of a node is where the closures so far place it."""
        poses = graph.poses
        return all(
            _is_same_place(compose(_placed(one, graph), between(poses[one.j], poses[node])), pose)
            for one in self._closures
        )

    def _compare_odometry(
        self, node: int, keys: KeyframeLog, graph: PoseGraph
    ) -> Comparison | None:
        """Compare a node with the map at the place that odometry gives, if it gives one."""
        begin = int(graph.roots[node])
        if not self._is_linked(begin, graph):
            return None
        driven = keys.distance[keys.nodes]
        distance = float(driven[node] - driven[begin])
        narrow = self._closer.window(distance)
        radius = narrow.x + BREAK_DRIFT * distance
        window = Window(radius, radius, max(narrow.heading, BREAK_DRIFT))
        result = self._closer.compare(node, graph.poses[node], window, keys, graph)
        self._compared.append(result)
        return result

    def _is_linked(self, root: int, graph: PoseGraph) -> bool:
        """Return whether odometry connects a session to the map."""
        begins = {gap.node for gap in self._breaks}
        while root in begins:
            root = int(graph.roots[root - 1])
        return root == 0

    def _required(self) -> float:
        """Return how many closures place a session elsewhere than odometry does."""
        against = sum(one.contradicts for one in self._compared)
        agreeing = sum(_distinct_closure(one) is not None for one in self._compared)
        if against > agreeing or not self._breaks or self._is_vague:
            return MIN_CLOSURES
        return math.inf if agreeing else MIN_SURPRISING_CLOSURES

    def _may_assume_odometry(self, node: int, keys: KeyframeLog) -> bool:
        """Return whether a session that could not be located may be joined to the map by odometry.

        It may after a long search, unless the map contradicts the scans of several nodes at the resulting
        poses, and of more than it agrees with. If it does not, the view has changed, but not the place.
        Nodes in unknown areas say nothing: a robot that was carried soon leaves the map by odometry.
        """
        driven = keys.distance[keys.nodes]
        if (
            self._is_contradicted
            or not self._breaks
            or driven[node] - driven[self._breaks[-1].node] < MIN_SEARCH_DISTANCE
        ):
            return False
        against = sum(one.contradicts for one in self._compared)
        agreeing = sum(one.closure is not None for one in self._compared)
        return against < MIN_CONTRADICTIONS or against <= agreeing

    def _join_breaks(self, graph: PoseGraph) -> None:
        """Join sessions by the motions from odometry, robustly: wrong ones have little weight."""
        for gap in self._breaks:
            information = inverse_of(gap.covariance)
            length = max(BREAK_LENGTH, self._closer.length(gap.radius))
            graph.add_closure(gap.node - 1, gap.node, gap.motion, information, length)
        self._breaks, self._compared, self._closures = [], [], []


def _distinct_closure(comparison: Comparison | None) -> PendingClosure | None:
    """Return a strong closure whose position is known in all directions, if there is one."""
    closure = None if comparison is None else comparison.closure
    if closure is None or not closure.is_strong:
        return None
    H = closure.closure.information
    position = H[:2, :2] - np.outer(H[:2, 2], H[2, :2]) / H[2, 2]  # whatever the heading
    return closure if np.linalg.eigvalsh(position)[0] > MAX_SIGMA**-2 else None


def _placed(closure: PendingClosure, graph: PoseGraph) -> Array:
    """Return the pose (3,) in the map of a closure's node j."""
    return compose(graph.poses[closure.i], closure.closure.pose)


def _distance(one: Array, other: Array) -> float:
    """Return the distance in m between two poses (3,)."""
    return math.dist(one[:2], other[:2])


def _is_same_place(one: Array, other: Array) -> bool:
    """Return whether two poses (3,) of the robot are closer than `SAME_PLACE`."""
    d = between(one, other)
    return bool(math.hypot(d[0], d[1]) < SAME_PLACE[0] and abs(d[2]) < SAME_PLACE[1])
