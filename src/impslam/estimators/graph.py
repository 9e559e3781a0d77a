"""Graph SLAM on one page: keyframes hang on nodes, nodes on a pose graph, which closures revise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import PrivateAttr

from impslam.building.landmarks import landmarks_of
from impslam.component import parameter, register
from impslam.errors import NumericalError
from impslam.estimators.base import Draft, Estimator, check_keyframe, is_known
from impslam.estimators.finding import Finder
from impslam.estimators.keyframe_log import KeyframeLog, Part, blended, refined, revised, spreads
from impslam.estimators.loop_closing import LoopCloser, LoopSearch, Place
from impslam.estimators.pose_graph import PoseGraph
from impslam.estimators.restoring import SURE, restored
from impslam.estimators.thinning import Thinner
from impslam.geometry.chain import advance
from impslam.geometry.se2 import between, compose, compose_uncertain
from impslam.health import ELSEWHERE
from impslam.landmarks.base import LandmarkModel
from impslam.map import Keyframe, Map, Revision
from impslam.noise import UNKNOWN
from impslam.tracking.base import KeyframeGate
from impslam.types import Array, Edges, Increment, Landmark, Observation

SOUGHT = 20.0
"""m of way after which a session that was not found may go on by odometry: six times a query's."""
MOST_CHECKED = 12  # nodes, of 30 m of way, that the map must not contradict


class _Break(NamedTuple):
    """Where scans stopped fitting: the first node after it, and the motion (3,) to it by odometry."""

    node: int
    motion: Array
    covariance: Array


@register("graph")
class Graph(Estimator):
    """A pose graph over the drive, with loop closures; landmarks are estimated on its poses."""

    goes_on: ClassVar[bool] = True
    tells_landmarks: ClassVar[bool] = False
    keyframes: ClassVar[KeyframeGate] = KeyframeGate(distance=0.4, angle=0.4, seconds=math.inf)

    spacing: float = parameter(
        2.5, "m", "way between nodes of the graph: drift over it is below a centimetre", gt=0
    )
    rounds: int = parameter(
        2, "1", "linearisations that refine all keyframes at the end", ge=1, le=100
    )
    loops: LoopSearch = parameter(LoopSearch(), "", "where closures are sought")

    _graph: PoseGraph = PrivateAttr(default_factory=PoseGraph)
    _closer: LoopCloser = PrivateAttr()
    _thinner: Thinner = PrivateAttr(default_factory=Thinner)
    _finder: Finder = PrivateAttr()
    _keys: KeyframeLog = PrivateAttr(default_factory=KeyframeLog)
    _since: tuple[Array, Array] = PrivateAttr()
    _breaks: list[_Break] = PrivateAttr(default_factory=list)
    _assumed: int | None = PrivateAttr(default=None)
    """The first node placed by odometry alone, as the robot was lost; None once a place is recognised."""
    _start: Array = PrivateAttr()
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _known: Map | None = PrivateAttr(None)
    _settled: Revision | None = PrivateAttr(None)

    def start(
        self,
        pose: Array,
        known: Map | None = None,
        frozen: bool = False,
        hint: Array | None = None,
        **parts: Any,
    ) -> None:
        """Begin at a pose (3,), or go on with a map; see `Estimator.start`."""
        self._start, self._models = pose, parts["models"]
        self._since = np.zeros(3), np.zeros((3, 3))
        if known is not None and len(known.keyframes):
            self._known = known if frozen else None
            self._keys, self._graph, self._since = restored(known, self.spacing, frozen=frozen)
            self._thinner.go_on(self._keys, frozen=frozen)
        self._finder = Finder(hint)
        self._closer = LoopCloser(self.loops if self._known is None else _close_by(self.loops))

    def add(self, keyframe: Keyframe) -> Revision:
        """Take in a keyframe; see `Estimator.add`."""
        self._settled = None
        used, refused = _usable(keyframe)
        self._drive(used, keyframe.motion)
        moved = False
        dropped: tuple[int, ...] = ()
        if self._is_new_node():
            dropped = self._thinner.thin(self._keys, self._graph)
            try:
                moved = self._close_loops(len(self._graph) - 2)
            except NumericalError as error:
                failed = f"no loop is closed at {keyframe.stamp:.3f} s: {error}"
                refused = "; ".join(filter(None, (refused, failed)))
        facts: dict[str, Any] = {"refused": refused, "dropped": dropped}
        facts["assumed"] = self._assumed is not None
        if moved:
            return replace(self._all(self._graph), **facts)
        pose, covariance = compose_uncertain(
            self._graph.poses[-1], self._graph.covariances[-1], *self._since
        )
        return Revision(
            np.array([keyframe.id]),
            pose[None],
            covariance[None],
            placed=not self._is_pending(),
            **facts,
        )

    def _is_pending(self) -> bool:
        """Tell whether the newest keyframe is in a session that is not placed in the map."""
        return bool(self._graph.roots[-1] != 0)

    def _drive(self, keyframe: Keyframe, told: Increment) -> None:
        """Let the chain go on by a keyframe's motion, or begin a session; keep what it saw.

        `told` is the motion as the tracker has it, by odometry alone where the scan does not fit.
        """
        d_pose, covariance = keyframe.motion.d_pose, keyframe.motion.covariance
        if len(self._graph) and not keyframe.lost:
            self._keys.add(keyframe)
            advance(*self._since, d_pose, covariance)
            return
        start = compose(self._graph.poses[-1], self._since[0]) if len(self._graph) else self._start
        self._keys.add(keyframe, start)
        if keyframe.reason == ELSEWHERE and is_known(told):
            motion = compose_uncertain(*self._since, told.d_pose, told.covariance)
            self._breaks.append(_Break(len(self._graph), *motion))
        self._graph.begin(self._keys.chain[-1], covariance)
        self._since = np.zeros(3), np.zeros((3, 3))

    def _is_new_node(self) -> bool:
        """Make the newest keyframe a node where the last one is far enough."""
        length = self._keys.since_node
        if length < self.spacing:
            return False
        self._graph.go_on(*self._since, length)
        self._keys.mark_node()
        self._since = np.zeros(3), np.zeros((3, 3))
        return True

    def seek_loops(self, begin: int) -> None:
        """Seek closures of all nodes from a keyframe on, the newest one aside, as when they were driven."""
        for node in range(int(np.searchsorted(self._keys.nodes, begin)), len(self._graph) - 1):
            with suppress(NumericalError):  # they are taken back
                self._close_loops(node)

    def _close_loops(self, node: int) -> bool:
        """Seek closures of a node, which is not the newest; tell whether the nodes have moved.

        Those that leave the graph without a solution are taken back, or no later one would have any.
        """
        before, assumed = self._graph.closures, self._assumed
        if node < 1:
            return False
        moved = self._closer.seek(node, self._keys, self._graph) or self._find_session(node)
        if moved:
            try:
                self._graph.solve()
            except NumericalError:
                self._graph.take_back(self._graph.closures - before)
                raise
        new = self._graph.closures - before
        if new and assumed is not None:
            edges = self._graph.edges
            if np.minimum(edges.i[-new:], edges.j[-new:]).min() < assumed:  # a place from before
                self._assumed = None
        return moved

    def _find_session(self, node: int) -> bool:
        """Seek where the pending session of the newest node lies; tell whether it is found."""
        keys, graph = self._keys, self._graph
        if not self._is_pending():
            return False
        found = self._finder.find(keys, graph)
        if found is not None:
            pose, likely = found
            pose = compose(pose, between(keys.chain[-1], keys.chain[keys.nodes[node]]))
            if self._closer.tie(Place(node, pose, likely), keys, graph):
                self._tie_breaks()
                return True
        if not self._may_go_on(node):
            return False
        first = self._breaks[0].node
        self._tie_breaks()
        if self._is_pending():
            return False
        self._assumed = first if self._assumed is None else self._assumed
        return True

    def _may_go_on(self, node: int) -> bool:
        """Tell whether a session that was not found may go on from the map by odometry.

        So it may once it has been sought for long, unless the map shows something else where its nodes
        are then: it was the view that changed, not the place.
        """
        keys, graph = self._keys, self._graph
        driven = keys.way[keys.nodes]
        if not self._breaks or driven[node] - driven[self._breaks[-1].node] < SOUGHT:
            return False
        nodes = range(max(self._breaks[-1].node, node - MOST_CHECKED), node)
        begin = driven[self._breaks[-1].node]
        against = sum(
            self._closer.contradicts(n, float(driven[n] - begin), keys, graph) for n in nodes
        )
        return 2 * against < len(nodes)

    def _tie_breaks(self) -> None:
        """Join sessions by the motion to each by odometry, which counts little if it is wrong."""
        for at in self._breaks:
            information = np.asarray(np.linalg.inv(at.covariance))
            self._graph.close(at.node - 1, at.node, at.motion, information)
        self._breaks = []

    def _all(self, graph: PoseGraph) -> Revision:
        """Return all keyframes by a graph."""
        poses, covariances = revised(self._keys, graph), spreads(self._keys, graph)
        placed = graph.roots[self._keys.node_before] == 0
        begin = 0 if self._known is None else len(self._known.keyframes)
        ids = np.arange(begin, len(poses))
        return Revision(ids, poses[begin:], covariances[begin:], placed=placed[begin:])

    def settle(self) -> Revision | None:
        """Refine all keyframes jointly; see `Estimator.settle`."""
        if len(self._graph) == 0:
            return None
        graph, refused = copy(self._graph), ""
        try:
            if graph.closures:
                graph.solve()
        except NumericalError as error:
            refused = f"the last closures are not in the map: {error}"
        settled = self._all(graph)
        part = _refinable(self._keys, graph)
        poses = refined(blended(self._keys, graph), self._keys, self.rounds, part)
        self._settled = replace(settled, poses=poses[settled.ids], refused=refused)
        return self._settled

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks on the keyframes' poses; after `settle` on the refined ones."""
        if self._known is not None:
            return self._known.landmarks
        if len(self._graph) == 0:
            return ()
        now = self._settled or self._all(self._graph)
        poses, covariances, seen, rows = now.poses, now.covariances, self._keys.seen, None
        if not np.all(now.placed):
            rows = np.flatnonzero(now.placed)
            poses, covariances, seen = poses[rows], covariances[rows], seen.part(rows)
        scans = self._keys.placed_scans(poses, rows)
        return landmarks_of(poses, covariances, seen, self._models, scans)

    def draft(self) -> Draft:
        """Return the estimate as it is now; see `Estimator.draft`."""
        frozen = self.model_copy()
        frozen._graph, frozen._keys = copy(self._graph), self._keys.copy()
        return Draft(frozen.settle, frozen.landmarks)

    def edges(self) -> Edges:
        """Return motions and closures between keyframes; see `Estimator.edges`."""
        edges, nodes = self._graph.edges, self._keys.nodes
        return edges._replace(i=nodes[edges.i], j=nodes[edges.j])

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return what the keyframes saw; see `Estimator.observations`."""
        return self._keys.seen.by_keyframe()

    def counts(self) -> Mapping[str, int]:
        """Return how many loop closures were sought, and how many the graph has."""
        tried = self._closer.recogniser.counts["attempts"]
        counts = {"loops tried": tried, "loops closed": self._graph.closures}
        first = np.unique(self._keys.sessions, return_index=True)[1]
        if len(first) > 1:
            pending = np.count_nonzero(self._graph.roots[self._keys.node_before[first]])
            counts |= {"sessions": len(first), "sessions not found": int(pending)}
        return counts

    @property
    def state_size(self) -> int:
        """Number of scalars that are estimated."""
        return self._graph.poses.size


def _close_by(search: LoopSearch) -> LoopSearch:
    """Return the search for a drive through a map that stays: every node is laid on it."""
    return search.model_copy(update={"way_back": 0.0})


def _refinable(keys: KeyframeLog, graph: PoseGraph) -> Part:
    """Return the keyframes that are placed and kept, with the closures that connect their sessions."""
    edges, nodes = graph.edges, keys.nodes
    rows = np.flatnonzero((graph.roots[keys.node_before] == 0) & keys.is_kept)
    i, j = nodes[edges.i], nodes[edges.j]
    links = (keys.sessions[i] != keys.sessions[j]) & np.isin(i, rows)
    ends = np.searchsorted(rows, i[links]), np.searchsorted(rows, j[links])
    rest = (column[links] for column in edges[2:])
    frozen = int(nodes[graph.frozen]) if 0 < graph.frozen < len(nodes) else 0
    return Part(rows, Edges(*ends, *rest), frozen)


def _usable(keyframe: Keyframe) -> tuple[Keyframe, str]:
    """Return what is usable of a keyframe, and what is wrong with the rest."""
    motion, wrong = keyframe.motion, ""
    if keyframe.lost:
        d_pose = np.where(np.isfinite(motion.d_pose), motion.d_pose, 0.0)
        motion = replace(motion, d_pose=d_pose, covariance=UNKNOWN * np.eye(3))
        keyframe = replace(keyframe, motion=motion)
    try:
        check_keyframe(keyframe)
        if not all(_is_definite(o.R) for o in keyframe.observations):
            wrong = "an extractor's R is no covariance"
    except NumericalError as error:
        wrong = str(error)
    if not is_known(motion):
        motion = replace(motion, d_pose=np.zeros(3), covariance=UNKNOWN * np.eye(3))
    motion = replace(motion, covariance=motion.covariance + SURE**2 * np.eye(3))
    if not wrong:
        return replace(keyframe, motion=motion), ""
    why = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {wrong}"
    return replace(keyframe, motion=motion, scan=None, observations=()), why


def _is_definite(R: Array) -> bool:
    """Tell whether R (d, d) may be a covariance; by its first pivot and its determinant."""
    if len(R) == 2:  # of nearly all observations; numpy's takes twenty times as long
        (a, b), (c, d) = R.tolist()
        return bool(a > 0.0 and a * d > b * c)
    return bool(R[0, 0] > 0.0 and np.linalg.det(R) > 0.0)
