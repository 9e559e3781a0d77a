"""Drops keyframes that add nothing, and folds nodes of the graph where there is one already.

So map and graph grow with the area, not with the time driven (Kretzschmar and Stachniss 2012). Each
keyframe is judged once, when closures of its pass have been found: it is laid on an earlier one beside
it. Where both show the same walls, it is known where it is from that one, and where what it shows was
seen before and nothing that was seen before is gone, it is dropped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.estimators.keyframe_log import KeyframeLog, motions, revised
from impslam.estimators.loop_closing import AFRESH, RECENT
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.algebra import between as between_in_kernel
from impslam.geometry.angles import wrap
from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between
from impslam.graph.bearings import Fans, nearest_feature, sort_by_bearing
from impslam.graph.bundle import Fit, refine
from impslam.graph.overlaps import PER_RADIAN
from impslam.graph.pose_graph import Edges
from impslam.recognition.submap import Floats
from impslam.recognition.verify import evidence_at
from impslam.types import Array, Ints, Mask

BATCH = 24  # keyframes that are judged at once, for the sake of speed: some 10 m of way
BESIDE, TURNED = 0.5, 0.4
"""m, rad: as far as keyframes of one pass are apart; so near, another one shows about the same."""
AROUND = 2.0  # m; keyframes so near have seen what one can add to
TIED = 12.0  # m along the graph: closures have brought both passes together
ALIKE = 0.5  # of the points of one that lie on surfaces of the other: both show the same walls
REACH = 0.15  # m to a point seen before: what poses err by that are not refined yet
COVERED = 0.95  # of the points, so near: the rest are people, and rays that graze an edge
GONE = 0.05  # of the points seen before that are in free space now, at most: some are people, too
PRIOR = np.array([0.01, 0.01, 0.002]) * 0.5 * TIED
"""m, m, rad: of the graph's pose of one keyframe from the other, by the drift (see `LoopSearch`, without
its margin) from the nearer of two closures. It holds them along bare corridors."""
FLOOR = np.array([0.01, 0.01, 0.002])
"""m, m, rad: as of a closure; what no number of points brings down."""


class Thinner:
    """Judges the keyframes of a drive, each once."""

    def __init__(self) -> None:
        self._judged = 0

    def go_on(self, keys: KeyframeLog, *, frozen: bool) -> None:
        """Go on with the keyframes of a map: the last ones are still to be judged, with `frozen` none."""
        recent = int(np.searchsorted(keys.way, keys.way[-1] - RECENT))
        self._judged = len(keys) if frozen else recent

    def thin(self, keys: KeyframeLog, graph: PoseGraph) -> tuple[int, ...]:
        """Judge what was driven long enough ago; return the keyframes that were dropped."""
        begin, end = self._judged, int(np.searchsorted(keys.way, keys.way[-1] - RECENT))
        if end - begin < BATCH:
            return ()
        self._judged = end
        rows = np.flatnonzero(keys.seeing[begin:end]) + begin
        near = _near(rows, begin, keys, graph) if len(rows) else rows
        laid = _lay(rows, near, keys, graph) if len(near) else None
        if laid is None:
            return ()
        nodes = np.searchsorted(keys.nodes, laid.rows)
        for k in np.flatnonzero(keys.nodes[nodes] == laid.rows):
            _fold(int(nodes[k]), int(laid.hosts[k]), laid.T[k], laid.covariances[k], keys, graph)
        rows = laid.rows[laid.redundant]
        keys.drop(rows, laid.hosts[laid.redundant], laid.T[laid.redundant])
        return tuple(rows.tolist())


class _Laid(NamedTuple):
    """Keyframes (m,) that show the same walls as others, their hosts.

    Attributes
    ----------
    rows, hosts : (m,)
    T, covariances : (m, 3), (m, 3, 3) of each seen from its host
    redundant : (m,) whether it adds nothing
    """

    rows: Ints
    hosts: Ints
    T: Array
    covariances: Array
    redundant: Mask


def _near(rows: Ints, before: int, keys: KeyframeLog, graph: PoseGraph) -> Ints:
    """Return the keyframes judged earlier that the graph ties to some rows, and that are close."""
    node = keys.node_before[rows[-1]]
    apart = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
    driven = float(keys.way[rows[-1]] - keys.way[rows[0]])
    near = (apart < driven + 2.0 * AROUND) & (graph.ways(node) < driven + TIED)
    return np.flatnonzero(near[keys.node_before[:before]] & keys.seeing[:before])


def _lay(rows: Ints, near: Ints, keys: KeyframeLog, graph: PoseGraph) -> _Laid | None:
    """Lay keyframes on those beside them, of which some are `near`; return where they show the same."""
    at, around = revised(keys, graph, rows), revised(keys, graph, near)
    offset = at[:, None] - around
    apart, turn = np.hypot(offset[..., 0], offset[..., 1]), np.abs(wrap(offset[..., 2]))
    beside = (
        (apart < BESIDE) & (turn < TURNED) & (keys.way[rows][:, None] > keys.way[near] + AFRESH)
    )
    chosen = np.flatnonzero(beside.any(1))
    if not len(chosen):
        return None
    seen = np.flatnonzero((apart[chosen] < AROUND).any(0))
    rows, at, near, around = rows[chosen], at[chosen], near[seen], around[seen]
    apart, turn, beside = (column[np.ix_(chosen, seen)] for column in (apart, turn, beside))
    best, m = np.where(beside, apart + PER_RADIAN * turn, np.inf).argmin(1), len(rows)
    scans = keys.scans(np.concatenate([rows, near]))
    poses, pairs = np.concatenate([at, around]), np.stack([best + m, np.arange(m)], 1)
    prior = np.broadcast_to(np.diag(1.0 / PRIOR**2), (m, 3, 3))
    known = Edges(best + m, np.arange(m), between(around[best], at), prior, np.full(m, np.inf))
    edges = known.joined(motions(keys, rows))
    done = refine(poses, scans, edges, pairs, np.arange(m, len(poses)), Fit(rounds=4))
    covariances = np.asarray(np.linalg.inv(done.information + prior)) + np.diag(FLOOR**2)
    T, hosts, alike = between(around[best], done.poses[:m]), near[best], done.shares >= ALIKE
    free = np.stack([keys.views[row].free for row in rows])
    fans = sort_by_bearing(scans)
    redundant = _redundant(fans, done.poses, best + m, apart < AROUND, free)
    return _Laid(rows[alike], hosts[alike], T[alike], covariances[alike], redundant[alike])


def _fold(
    node: int, host: int, T_host_node: Array, covariance: Array, keys: KeyframeLog, graph: PoseGraph
) -> None:
    """Fold a node, seen from a keyframe, into the node before that keyframe."""
    into = int(keys.node_before[host])
    T, P = np.zeros(3), np.zeros((3, 3))
    for row in range(keys.nodes[into] + 1, host + 1):
        advance(T, P, between(keys.chain[row - 1], keys.chain[row]), keys.steps[row])
    advance(T, P, T_host_node, covariance)
    graph.fold(node, into, T, P)


@kernel
def _redundant(fans: Fans, poses: Array, hosts: Ints, near: Mask, free: Floats) -> Mask:
    """Return whether each of the first m scans adds nothing to the n others; all are at `poses`.

    hosts (m,) are the scans beside them, near (m, n) which of the others are, and free (m, BEARINGS)
    their free ranges; see `View`.
    """
    scans, m = fans.scans, len(near)
    out, T, vantage = np.empty(m, np.bool_), np.empty(3), np.zeros((1, 3))
    for k in range(m):
        begin, end = scans.starts[k], scans.starts[k + 1]
        known = np.zeros(end - begin, np.bool_)
        for n in range(near.shape[1]):
            if not near[k, n]:
                continue
            between_in_kernel(poses[m + n], poses[k], T)
            for p in range(begin, end):
                if not known[p - begin]:
                    x, y = _moved(T, scans.features[p, 0], scans.features[p, 1])
                    known[p - begin] = nearest_feature(fans, m + n, x, y, REACH) >= 0
        between_in_kernel(poses[k], poses[hosts[k]], T)
        vantage[0, :2] = scans.lasers[k]
        begin, end, gone = scans.starts[hosts[k]], scans.starts[hosts[k] + 1], 0
        for p in range(begin, end):
            x, y = _moved(T, scans.features[p, 0], scans.features[p, 1])
            gone += evidence_at(x, y, vantage, free[k : k + 1]) < 0
        out[k] = known.mean() >= COVERED and gone <= GONE * (end - begin)
    return out


@kernel
def _moved(T: Array, x: float, y: float) -> tuple[float, float]:
    """Return a point moved by T (3,)."""
    c, s = math.cos(T[2]), math.sin(T[2])
    return T[0] + c * x - s * y, T[1] + s * x + c * y
