"""Locate a pending session, which no edge connects to the map yet.

The scans of its last metres are searched for everywhere in the map. The result is a guess: the loop closer
of the graph verifies it, and `sessions` accepts it once several agree.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from impslam.estimators.keyframe_log import KeyframeLog, revised
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.se2 import between, compose, inverse
from impslam.types import Array

if TYPE_CHECKING:
    from impslam.recognition.relocalisation import Near, Relocaliser

QUERY_DISTANCE = 3.0  # m: covers several rooms or doors, and motion over it is known to centimetres
HINT_RADIUS = 3.0  # m, accuracy of a place that a user points at
REVIEW_DISTANCE = 100.0
"""m of a session's drive that are compared with the map. On simulated floors with equal corridors, the
share of the beams that contradict the map settles within 50 m."""
MIN_KNOWN = 0.3
"""Share of beams that end in known space; with fewer, the map does not correct drift."""
MIN_PROBABILITY = 0.98  # among the places found; the search may have missed others
HINT_DRIFT = 0.1  # m/m, drift since the hinted place


class Guess(NamedTuple):
    """A possible pose (3,) of a node in the map.

    Attributes
    ----------
    pose : (3,) the best pose
    likely : whether it is likely, among the places found
    hinted : whether a user gave the area
    """

    pose: Array
    likely: bool
    hinted: bool


class SessionFinder:
    """Locates pending sessions; `hint` (3,) or (2,) is the approximate start of the first one."""

    def __init__(self, hint: Array | None = None) -> None:
        self._hint = hint
        self._session = -1
        self._map: Relocaliser | None = None

    def find(self, node: int, keys: KeyframeLog, graph: PoseGraph) -> Guess | None:
        """Return a guess of a node's pose in the map from the newest scans, if there is one."""
        from impslam.recognition.relocalisation import (  # noqa: PLC0415  few runs need it
            Relocaliser,
            query,
        )

        session = int(keys.sessions[-1])
        if session != self._session:
            if self._session >= 0:  # not the first one
                self._hint = None
            self._map, self._session = None, session
        rows = np.flatnonzero(keys.distance >= keys.distance[-1] - QUERY_DISTANCE)
        views = [keys.views[row] for row in rows.tolist()]
        scans = [view for view in views if view is not None]
        if not scans or views[-1] is None:
            return None
        if self._map is None:
            placed = np.flatnonzero(graph.roots[keys.node_before] == 0)
            self._map = Relocaliser(keys.keyframes(revised(keys, graph), placed))
        poses = keys.chain[[row for row, view in zip(rows, views, strict=True) if view is not None]]
        near = self._near(keys)
        answer = self._map.find_query(query(scans, poses), near)
        allowed = (h for h in answer.hypotheses if self._begins_near_hint(h.pose, keys))
        best = next(allowed, None)
        if best is None:
            return None
        pose = compose(best.pose, between(keys.chain[-1], keys.chain[keys.nodes[node]]))
        return Guess(pose, best.probability >= MIN_PROBABILITY, near is not None)

    def misfit(self, row: int, pose: Array, keys: KeyframeLog) -> float:
        """Return the share of the newest session's beams that contradict the map.

        The drive is followed back from keyframe `row`, which is at a pose (3,), until it leaves the map.
        Each stretch is aligned with the map, so that drift does not add up. NaN if nothing can be compared.
        """
        from impslam.recognition.relocalisation import query  # noqa: PLC0415

        if self._map is None:
            return math.nan
        against = known = 0.0
        for rows in _stretches_back(row, keys):
            pose = compose(pose, between(keys.chain[row], keys.chain[rows[-1]]))
            row = rows[-1]
            scans = query([view for k in rows if (view := keys.views[k])], keys.chain[rows])
            pose = self._map.align(scans, pose)
            seen = self._map.explain(scans, pose)
            against, known = against + seen.contradicting, known + seen.known
            if seen.known < MIN_KNOWN:
                break
        return against / known if known else math.nan

    def _near(self, keys: KeyframeLog) -> Near | None:
        """Return the area of the newest keyframe according to the hint, if there is one."""
        from impslam.recognition.relocalisation import Near  # noqa: PLC0415

        if self._hint is None:
            return None
        motion, distance = _driven(keys)
        if len(self._hint) == 2:
            return Near(self._hint, HINT_RADIUS + distance)
        return Near(compose(self._hint, motion), HINT_RADIUS + HINT_DRIFT * distance)

    def _begins_near_hint(self, pose: Array, keys: KeyframeLog) -> bool:
        """Return whether the session began near the hint, if the newest keyframe is at a pose (3,)."""
        if self._hint is None:
            return True
        motion, distance = _driven(keys)
        start = compose(pose, inverse(motion))
        return math.dist(start[:2], self._hint[:2]) <= HINT_RADIUS + HINT_DRIFT * distance


def _stretches_back(row: int, keys: KeyframeLog) -> Iterator[list[int]]:
    """Yield the keyframes with views of each stretch of the newest session, from keyframe `row` back."""
    first = int(np.searchsorted(keys.sessions, keys.sessions[-1]))
    least = keys.distance[row] - REVIEW_DISTANCE
    while row >= first and keys.distance[row] >= least:
        begin = int(np.searchsorted(keys.distance, keys.distance[row] - QUERY_DISTANCE))
        rows = [k for k in range(max(begin, first), row + 1) if keys.views[k] is not None]
        if rows:
            yield rows
        row = max(begin, first) - 1


def _driven(keys: KeyframeLog) -> tuple[Array, float]:
    """Return the motion (3,) in the newest session so far, and its length, m."""
    first = int(np.searchsorted(keys.sessions, keys.sessions[-1]))
    distance = float(keys.distance[-1] - keys.distance[first])
    return between(keys.chain[first], keys.chain[-1]), distance
