"""Finds where in the map a session lies that nothing connects to it yet.

The scans of its last metres are sought everywhere in the map. What is found is a guess: the graph's
loop closer verifies it, and believes it once a second one agrees.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from impslam.estimators.keyframe_log import KeyframeLog, revised
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.se2 import between, compose
from impslam.types import Array

if TYPE_CHECKING:
    from impslam.recognition.relocalisation import Near, Relocaliser

WAY = 3.0  # m: several rooms or doors are seen on it, and motion along it is known to centimetres
RADIUS = 3.0  # m: a place pointed at on a map is the one meant, so far around
LIKELY = 0.98  # odds among the places found; the search may have left out others, which others tell
DRIFT = 0.1  # m of way: what the way since that place may have strayed by


class Finder:
    """Seeks pending sessions; `hint` (3,) or (2,) is about where the first of them begins."""

    def __init__(self, hint: Array | None = None) -> None:
        self._hint = hint
        self._session = -1
        self._map: Relocaliser | None = None

    def find(self, keys: KeyframeLog, graph: PoseGraph) -> tuple[Array, bool] | None:
        """Return where the newest keyframe may be in the map: (3,), and whether it is likely there.

        None if nothing can be told.
        """
        from impslam.recognition.relocalisation import (  # noqa: PLC0415  few runs need it
            Relocaliser,
            query,
        )

        session = int(keys.sessions[-1])
        if session != self._session:
            self._map, self._session = None, session
        rows = np.flatnonzero(keys.way >= keys.way[-1] - WAY)
        views = [keys.views[row] for row in rows.tolist()]
        seen = [view for view in views if view is not None]
        if not seen or views[-1] is None:
            return None
        if self._map is None:
            placed = np.flatnonzero(graph.roots[keys.node_before] == 0)
            self._map = Relocaliser(keys.keyframes(revised(keys, graph), placed))
        poses = keys.chain[[row for row, view in zip(rows, views, strict=True) if view is not None]]
        answer = self._map.find_query(query(seen, poses), self._near(keys))
        if not answer.hypotheses:
            return None
        best = answer.hypotheses[0]
        return best.pose, best.odds >= LIKELY

    def _near(self, keys: KeyframeLog) -> Near | None:
        """Return about where the newest keyframe is, as far as the hint tells."""
        from impslam.recognition.relocalisation import Near  # noqa: PLC0415

        if self._hint is None:
            return None
        first = int(np.searchsorted(keys.sessions, keys.sessions[-1]))
        driven = between(keys.chain[first], keys.chain[-1])
        way = float(keys.way[-1] - keys.way[first])
        if len(self._hint) == 2:
            return Near(self._hint, RADIUS + way)
        return Near(compose(self._hint, driven), RADIUS + DRIFT * way)
