"""Graph SLAM: keyframes are relative to nodes of a pose graph, which loop closures revise."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.building.landmarks import landmarks_of
from impslam.component import parameter, register
from impslam.errors import NumericalError
from impslam.estimators.base import MIN_SIGMA, Draft, Estimator, is_finite, with_motion
from impslam.estimators.keyframe_log import (
    KeyframeLog,
    Part,
    blended,
    keyframe_covariances,
    refined,
    revised,
)
from impslam.estimators.loop_closing import MIN_CONTRADICTIONS, LoopCloser, LoopSearch
from impslam.estimators.map_scale import landmark_with_scale, with_scale
from impslam.estimators.place_ambiguity import as_session_start, fits_elsewhere
from impslam.estimators.pose_graph import PoseGraph
from impslam.estimators.restoring import restored
from impslam.estimators.sessions import SessionPlacer
from impslam.estimators.thinning import Thinner
from impslam.geometry.chain import advance
from impslam.geometry.se2 import compose, compose_uncertain
from impslam.health import ELSEWHERE
from impslam.landmarks.base import LandmarkModel
from impslam.map import Keyframe, Map, Revision
from impslam.noise import LEAST_UNKNOWN, UNKNOWN
from impslam.tracking.base import KeyframeGate
from impslam.types import NO_COVARIANCE, Array, Edges, Increment, Landmark, Observation

_MIN_COVARIANCE = MIN_SIGMA**2 * np.eye(3)


@register("graph")
class Graph(Estimator):
    """A pose graph of the drive with loop closures; landmarks are estimated from its poses."""

    can_continue: ClassVar[bool] = True
    keyframes: ClassVar[KeyframeGate] = KeyframeGate(distance=0.4, angle=0.4, seconds=math.inf)

    spacing: float = parameter(
        2.5, "m", "distance between nodes of the graph: drift over it is below a centimetre", gt=0
    )
    rounds: int = parameter(
        2, "1", "linearisations that refine all keyframes at the end", ge=1, le=100
    )
    scale_sigma: float = parameter(
        0.01,
        "1",
        "standard deviation of the scale of a lidar's ranges, and so of the map: a data sheet's 1 %",
        ge=0,
        le=1,
    )
    loops: LoopSearch = parameter(LoopSearch(), "", "where to search for closures")

    _graph: PoseGraph = PrivateAttr(default_factory=PoseGraph)
    _closer: LoopCloser = PrivateAttr()
    _thinner: Thinner = PrivateAttr(default_factory=Thinner)
    _sessions: SessionPlacer = PrivateAttr()
    _keys: KeyframeLog = PrivateAttr(default_factory=KeyframeLog)
    _since: tuple[Array, Array] = PrivateAttr()
    _start: Array = PrivateAttr()
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _known: Map | None = PrivateAttr(None)
    _is_continued: bool = PrivateAttr(False)
    """Whether a map with keyframes is continued, which stays the map whatever follows."""
    _closed_before: int = PrivateAttr(0)
    """Number of closures of the map that is continued."""
    _refined: Revision | None = PrivateAttr(None)
    _final: PoseGraph | None = PrivateAttr(None)
    """The graph with the closures of the newest node, after `refine`."""
    _final_closer: LoopCloser = PrivateAttr()

    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        self._start, self._models = pose, parts["models"]
        self._since = np.zeros(3), np.zeros((3, 3))
        self._closer = LoopCloser(self.loops)
        self._sessions = SessionPlacer(self._closer)

    def resume(self, known: Map, *, frozen: bool = False, hint: Array | None = None) -> None:
        """Continue a map; see `Estimator.resume`."""
        if len(known.keyframes):
            self._keys, self._graph, self._since = restored(known, self.spacing, frozen=frozen)
            self._is_continued, self._closed_before = True, self._graph.closures
            self._thinner.resume(self._keys, frozen=frozen)
            if frozen:
                self._known, self._closer = known, LoopCloser(_everywhere(self.loops))
        self._sessions = SessionPlacer(self._closer, hint)

    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe; see `Estimator.add`."""
        self._refined = self._final = None
        if self._may_be_elsewhere(keyframe):
            keyframe = as_session_start(keyframe)
        used, refused = _usable(keyframe)
        moved, failed = False, ""
        if used.lost:  # nothing more will be seen around the newest node
            moved, failed = self._try_to_close_loops(len(self._graph) - 1, keyframe.stamp)
        self._extend_chain(used, keyframe.motion)
        dropped: tuple[int, ...] = ()
        if self._add_node_if_due():
            dropped = self._thinner.thin(self._keys, self._graph)
            moved, failed = self._try_to_close_loops(len(self._graph) - 2, keyframe.stamp)
        facts: dict[str, Any] = {
            "refused": "; ".join(filter(None, (refused, failed))),
            "dropped": dropped,
            "assumed": self._sessions.is_assumed,
            "contradicted": bool(self._closer.contradicted),
        }
        if moved:
            return replace(self._with_scale(self._revise_all(self._graph)), **facts)
        pose, covariance = compose_uncertain(
            self._graph.poses[-1], self._graph.covariances[-1], *self._since
        )
        return Revision(
            np.array([keyframe.id]),
            pose[None],
            self._including_scale(covariance[None], pose[None]),
            placed=bool(self._graph.roots[-1] == 0),
            begins=(keyframe.id,) if keyframe.lost else (),
            **facts,
        )

    def _may_be_elsewhere(self, keyframe: Keyframe) -> bool:
        """Return whether a keyframe may be at another place within its reach, if it has any."""
        if keyframe.reach[0] == 0.0 or not is_finite(keyframe.motion) or not len(self._graph):
            return False
        if self._graph.roots[-1] != 0:  # the map cannot tell
            return True
        before = compose(self._graph.poses[-1], self._since[0])
        return fits_elsewhere(before, keyframe, self._keys, self._graph)

    def _extend_chain(self, keyframe: Keyframe, tracked: Increment) -> None:
        """Extend the chain by a keyframe, or begin a session with it.

        `tracked` is the motion from the tracker; it is from odometry alone if the scan does not fit.
        """
        d_pose, covariance = keyframe.motion.d_pose, keyframe.motion.covariance
        if len(self._graph) and not keyframe.lost:
            self._keys.add(keyframe)
            advance(*self._since, d_pose, covariance)
            return
        start = compose(self._graph.poses[-1], self._since[0]) if len(self._graph) else self._start
        self._keys.add(keyframe, start)
        motion = None
        is_known = is_finite(tracked) and tracked.covariance[0, 0] < LEAST_UNKNOWN
        if keyframe.reason == ELSEWHERE and is_known:
            spread = tracked.covariance + _MIN_COVARIANCE  # 0 if the robot stands
            motion = compose_uncertain(*self._since, tracked.d_pose, spread)
        self._sessions.begin(len(self._graph), motion)
        self._graph.add_root(self._keys.chain[-1], covariance)
        self._since = np.zeros(3), np.zeros((3, 3))

    def _add_node_if_due(self) -> bool:
        """Make the newest keyframe a node if the last one is far enough; return whether it is."""
        length = self._keys.since_node
        if length < self.spacing:
            return False
        self._graph.extend(*self._since, length)
        self._keys.mark_node()
        self._since = np.zeros(3), np.zeros((3, 3))
        return True

    def search_loops(self, begin: int) -> None:
        """Search closures of all nodes from a keyframe on except the newest, as during the drive."""
        for node in range(int(np.searchsorted(self._keys.nodes, begin)), len(self._graph) - 1):
            with suppress(NumericalError):  # such closures are removed
                self._close_loops(node)

    def _try_to_close_loops(self, node: int, stamp: float) -> tuple[bool, str]:
        """Search closures of a node; return whether the nodes have moved, and the error if that fails."""
        try:
            return self._close_loops(node), ""
        except NumericalError as error:
            is_apart = bool(self._graph.roots[-1] != 0)  # nodes may have been separated
            return is_apart, f"no loop is closed at {stamp:.3f} s: {error}"

    def _close_loops(self, node: int) -> bool:
        """Search closures of a node that is seen no more; return whether the nodes have moved."""
        if node < 1:
            return False
        keys, graph = self._keys, self._graph
        moved = self._joined(
            lambda: (
                self._closer.search(node, keys, graph) or self._sessions.place(node, keys, graph)
            )
        )
        first = self._separate_contradicted()
        if first is not None:
            self._joined(lambda: self._placed_again(first, node))
        return moved or first is not None

    def _placed_again(self, first: int, last: int) -> bool:
        """Try to place the nodes that have just been separated; their covariances change in any case."""
        for node in range(first, last + 1):
            self._sessions.place(node, self._keys, self._graph)
        return True

    def _joined(self, close: Callable[[], bool]) -> bool:
        """Call a function that adds closures and returns whether nodes move; solve the graph if they do.

        If the graph then has no solution, the closures are removed, else no later ones would have any.
        """
        graph, sessions = copy(self._graph), self._sessions.copy()
        try:
            moved = close()
            if moved:
                self._graph.solve()
        except NumericalError:
            self._graph, self._sessions = graph, sessions
            raise
        if sessions.is_assumed:
            self._sessions.confirm(self._graph.closures - graph.closures, self._graph)
        return moved

    def _separate_contradicted(self) -> int | None:
        """Take the newest nodes out of the map if it contradicts several in a row; return the first one.

        The robot was carried, or its pose was lost, before the first of them without notice.
        """
        if len(self._closer.contradicted) < MIN_CONTRADICTIONS:
            return None
        self._closer.contradicted = []
        first = self._closer.doubtful
        return first if self._sessions.separate(first, self._keys, self._graph) else None

    def _revise_all(self, graph: PoseGraph) -> Revision:
        """Return the poses of all keyframes according to a graph."""
        poses, covariances = revised(self._keys, graph), keyframe_covariances(self._keys, graph)
        placed = graph.roots[self._keys.node_before] == 0
        begin = 0 if self._known is None else len(self._known.keyframes)
        ids = np.arange(begin, len(poses))
        return Revision(
            ids,
            poses[begin:],
            covariances[begin:],
            placed=placed[begin:],
            begins=self._keys.begins,
        )

    def _including_scale(self, covariances: Array, poses: Array) -> Array:
        """Return covariances that include that of the scale; in a frozen map they are relative to it."""
        if self._known is not None:
            return covariances
        return with_scale(covariances, poses, self._origin, self.scale_sigma)

    def _with_scale(self, revision: Revision) -> Revision:
        covariances = self._including_scale(revision.covariances, revision.poses)
        return replace(revision, covariances=covariances)

    def refine(self) -> Revision | None:
        """Refine all keyframes jointly; see `Estimator.refine`."""
        if len(self._graph) == 0:
            return None
        graph, refused, self._final_closer = copy(self._graph), "", self._closer.copy()
        try:
            self._final_closer.search(len(graph) - 1, self._keys, graph)
            if graph.closures:
                graph.solve()
            self._leave_out_first_scan(graph)
        except NumericalError as error:
            graph, refused = copy(self._graph), f"the last closures are not in the map: {error}"
        self._final = graph
        revision = self._revise_all(graph)
        part = _refinable(self._keys, graph)
        poses = refined(blended(self._keys, graph), self._keys, self.rounds, part)
        self._refined = replace(revision, poses=poses[revision.ids], refused=refused)
        return self._with_scale(self._refined)

    def _leave_out_first_scan(self, graph: PoseGraph) -> None:
        """If the map is a single keyframe, let it begin with the longest later session instead.

        A robot that is carried after it was switched on is never found at that keyframe.
        """
        sessions = graph.roots[self._keys.node_before]
        first, lengths = np.unique(sessions, return_counts=True)
        if self._is_continued or lengths[0] > 1 or lengths.max() == 1:
            return
        graph.begin_map_at(int(first[np.argmax(lengths)]), _MIN_COVARIANCE)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks at the keyframes' poses; after `refine`, at the refined ones."""
        if self._known is not None:
            return self._known.landmarks
        if len(self._graph) == 0:
            return ()
        revision = self._refined or self._revise_all(self._graph)
        poses, covariances, rows = revision.poses, revision.covariances, None
        sightings = self._keys.sightings
        if not np.all(revision.placed):
            rows = np.flatnonzero(revision.placed)
            poses, covariances, sightings = poses[rows], covariances[rows], sightings.part(rows)
        scans = self._keys.placed_scans(poses, rows)
        found = landmarks_of(poses, covariances, sightings, self._models, scans)
        origin = self._origin
        return tuple(landmark_with_scale(mark, origin, self.scale_sigma) for mark in found)

    @property
    def _origin(self) -> Array:
        """Position (2,) m of the first node of the map."""
        graph = self._final or self._graph
        return graph.poses[graph.first, :2]

    def landmark_covariance(self) -> Array:
        """Return the joint covariance of a frozen map, whose landmarks do not change; else (0, 0)."""
        return NO_COVARIANCE if self._known is None else self._known.landmark_covariance

    def draft(self) -> Draft:
        """Return a snapshot of the estimate; see `Estimator.draft`."""
        snapshot = self.model_copy()
        snapshot._graph, snapshot._keys = copy(self._graph), self._keys.copy()
        snapshot._closer = self._closer.copy()
        return Draft(snapshot.refine, snapshot.landmarks, snapshot.edges, self.landmark_covariance)

    def edges(self) -> Edges:
        """Return motions and closures between keyframes; see `Estimator.edges`."""
        edges, nodes = (self._final or self._graph).edges, self._keys.nodes
        return edges._replace(i=nodes[edges.i], j=nodes[edges.j])

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return the observations of each keyframe; see `Estimator.observations`."""
        return self._keys.sightings.by_keyframe()

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of loop closures tried and closed in this run, and of sessions."""
        closer = self._closer if self._final is None else self._final_closer
        tried = closer.recogniser.counts["attempts"]
        closed = (self._final or self._graph).closures - self._closed_before
        counts = {"loops tried": tried, "loops closed": closed}
        begins = self._keys.begins
        if len(begins) > 1:
            pending = np.count_nonzero(self._graph.roots[self._keys.node_before[list(begins)]])
            counts |= {"sessions": len(begins), "sessions not found": int(pending)}
        return counts

    @property
    def state_size(self) -> int:
        """Number of scalars that are estimated."""
        return self._graph.poses.size


def _everywhere(search: LoopSearch) -> LoopSearch:
    """Return the search in a frozen map, to which every node is aligned."""
    return search.model_copy(update={"min_path": 0.0})


def _refinable(keys: KeyframeLog, graph: PoseGraph) -> Part:
    """Return the keyframes that are placed and kept, with the closures between their sessions."""
    edges, nodes = graph.edges, keys.nodes
    rows = np.flatnonzero((graph.roots[keys.node_before] == 0) & keys.is_kept)
    i, j = nodes[edges.i], nodes[edges.j]
    links = (keys.sessions[i] != keys.sessions[j]) & np.isin(i, rows) & np.isin(j, rows)
    ends = np.searchsorted(rows, i[links]), np.searchsorted(rows, j[links])
    rest = (column[links] for column in edges[2:])
    frozen = int(nodes[graph.frozen]) if 0 < graph.frozen < len(nodes) else 0
    return Part(rows, Edges(*ends, *rest), frozen)


def _usable(keyframe: Keyframe) -> tuple[Keyframe, str]:
    """Return the usable part of a keyframe, and what is wrong with the rest, or ""."""
    motion = keyframe.motion
    if keyframe.lost:
        d_pose = np.where(np.isfinite(motion.d_pose), motion.d_pose, 0.0)
        motion = replace(motion, d_pose=d_pose, covariance=UNKNOWN * np.eye(3))
        keyframe = replace(keyframe, motion=motion)
    if not is_finite(motion):
        motion = replace(motion, d_pose=np.zeros(3), covariance=UNKNOWN * np.eye(3))
    motion = replace(motion, covariance=motion.covariance + _MIN_COVARIANCE)
    return with_motion(keyframe, motion)
