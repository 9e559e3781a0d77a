"""Drop redundant keyframes, and fold nodes of the graph into nearby earlier ones.

The number of scans and of edges then grows with the area, not with the time driven (Kretzschmar and
Stachniss 2012); the rows of poses, a few hundred bytes each, grow with that. Each keyframe is judged once,
after the search for closures of its pass: it is aligned with an earlier one nearby. If both show the same
walls, its pose is measured relative to that one; if it also shows nothing new, and nothing seen before has
disappeared, it is dropped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.estimators.keyframe_log import KeyframeLog, motions, revised
from impslam.estimators.loop_closing import CONFIRMATION_DISTANCE, PASS_DISTANCE
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.algebra import between as between_in_kernel
from impslam.geometry.angles import wrap
from impslam.geometry.chain import advance
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between
from impslam.graph.bearings import Fans, nearest_feature, sort_by_bearing
from impslam.graph.bundle import RefinementSettings, refine
from impslam.graph.overlaps import HIDDEN_PER_RADIAN
from impslam.recognition.free_ranges import Floats
from impslam.recognition.places import MIN_SIGMA
from impslam.recognition.verify import evidence_at
from impslam.types import Array, Edges, Ints, Mask

BATCH = 24  # keyframes, over some 10 m, that are judged at once for speed
MAX_DISTANCE, MAX_TURN = 0.5, 0.4
"""m, rad between a keyframe and its host, as between keyframes of one pass: both show about the same."""
NEIGHBOUR_RADIUS = 2.0  # m; a keyframe is compared with others so near
MAX_PATH = 12.0  # m along the graph: closures have connected both passes
MIN_MATCHED = 0.5  # share of points on surfaces of the other keyframe: both show the same walls
POINT_RADIUS = 0.15  # m to a point seen before: error of poses that are not refined yet
MIN_COVERED = 0.95  # share of points so near: the rest are people, and beams that graze an edge
MAX_GONE = 0.05  # share of the points seen before that are in free space now: some are people, too
PRIOR_SIGMA = np.array([0.01, 0.01, 0.002]) * 0.5 * MAX_PATH
"""m, m, rad, of the relative pose from the graph: the drift (see `LoopSearch`, without its margin) from the
nearer of two closures. It constrains the alignment along bare corridors."""


class Thinner:
    """Judges each keyframe of a drive once."""

    def __init__(self) -> None:
        self._judged = 0

    def resume(self, keys: KeyframeLog, *, frozen: bool) -> None:
        """Continue with the keyframes of a map: the last ones are judged later; with `frozen`, none."""
        recent = int(np.searchsorted(keys.distance, keys.distance[-1] - CONFIRMATION_DISTANCE))
        self._judged = len(keys) if frozen else recent

    def thin(self, keys: KeyframeLog, graph: PoseGraph) -> tuple[int, ...]:
        """Judge keyframes that closures can no longer affect; return the dropped ones."""
        begin = self._judged
        end = int(np.searchsorted(keys.distance, keys.distance[-1] - CONFIRMATION_DISTANCE))
        if end - begin < BATCH:
            return ()
        self._judged = end
        rows = np.flatnonzero(keys.has_view[begin:end]) + begin
        near = _near(rows, begin, keys, graph) if len(rows) else rows
        aligned = _align(rows, near, keys, graph) if len(near) else None
        if aligned is None:
            return ()
        nodes = np.searchsorted(keys.nodes, aligned.rows)
        for k in np.flatnonzero(keys.nodes[nodes] == aligned.rows):
            T, covariance = aligned.T[k], aligned.covariances[k]
            _fold(int(nodes[k]), int(aligned.hosts[k]), T, covariance, keys, graph)
        rows = aligned.rows[aligned.redundant]
        keys.drop(rows, aligned.hosts[aligned.redundant], aligned.T[aligned.redundant])
        return tuple(rows.tolist())


class _Aligned(NamedTuple):
    """Keyframes (m,) that are aligned with earlier ones of the same walls, their hosts.

    Attributes
    ----------
    rows, hosts : (m,)
    T, covariances : (m, 3), (m, 3, 3) pose of each relative to its host
    redundant : (m,) whether it adds nothing
    """

    rows: Ints
    hosts: Ints
    T: Array
    covariances: Array
    redundant: Mask


def _near(rows: Ints, before: int, keys: KeyframeLog, graph: PoseGraph) -> Ints:
    """Return the keyframes judged earlier that are close to some rows, also along the graph."""
    node = keys.node_before[rows[-1]]
    offsets = np.hypot(*(graph.poses[:, :2] - graph.poses[node, :2]).T)
    driven = float(keys.distance[rows[-1]] - keys.distance[rows[0]])
    near = offsets < driven + 2.0 * NEIGHBOUR_RADIUS
    near &= graph.path_lengths(node) < driven + MAX_PATH
    return np.flatnonzero(near[keys.node_before[:before]] & keys.has_view[:before])


def _align(rows: Ints, near: Ints, keys: KeyframeLog, graph: PoseGraph) -> _Aligned | None:
    """Align keyframes with close ones among `near`; return those that show the same walls."""
    at, around = revised(keys, graph, rows), revised(keys, graph, near)
    offset = at[:, None] - around
    distance, turn = np.hypot(offset[..., 0], offset[..., 1]), np.abs(wrap(offset[..., 2]))
    can_host = (distance < MAX_DISTANCE) & (turn < MAX_TURN)
    can_host &= keys.distance[rows][:, None] > keys.distance[near] + PASS_DISTANCE
    chosen = np.flatnonzero(can_host.any(1))
    if not len(chosen):
        return None
    seen = np.flatnonzero((distance[chosen] < NEIGHBOUR_RADIUS).any(0))
    rows, at, near, around = rows[chosen], at[chosen], near[seen], around[seen]
    distance, turn, can_host = (
        column[np.ix_(chosen, seen)] for column in (distance, turn, can_host)
    )
    best, m = np.where(can_host, distance + HIDDEN_PER_RADIAN * turn, np.inf).argmin(1), len(rows)
    scans = keys.scans(np.concatenate([rows, near]))
    poses, pairs = np.concatenate([at, around]), np.stack([best + m, np.arange(m)], 1)
    prior = np.broadcast_to(np.diag(1.0 / PRIOR_SIGMA**2), (m, 3, 3))
    known = Edges(best + m, np.arange(m), between(around[best], at), prior, np.full(m, np.inf))
    edges = known.joined(motions(keys, rows))
    done = refine(
        poses, scans, edges, pairs, np.arange(m, len(poses)), RefinementSettings(rounds=4)
    )
    covariances = np.asarray(np.linalg.inv(done.information + prior)) + np.diag(MIN_SIGMA**2)
    T, hosts = between(around[best], done.poses[:m]), near[best]
    matched = done.shares >= MIN_MATCHED
    free = np.stack([keys.views[row].free for row in rows])
    fans = sort_by_bearing(scans)
    redundant = _redundant(fans, done.poses, best + m, distance < NEIGHBOUR_RADIUS, free)
    return _Aligned(
        rows[matched], hosts[matched], T[matched], covariances[matched], redundant[matched]
    )


def _fold(
    node: int, host: int, T_host_node: Array, covariance: Array, keys: KeyframeLog, graph: PoseGraph
) -> None:
    """Fold a node, whose pose is relative to a keyframe, into the node before that keyframe."""
    into = int(keys.node_before[host])
    T, P = np.zeros(3), np.zeros((3, 3))
    for row in range(keys.nodes[into] + 1, host + 1):
        advance(T, P, between(keys.chain[row - 1], keys.chain[row]), keys.steps[row])
    advance(T, P, T_host_node, covariance)
    graph.fold(node, into, T, P)


@kernel
def _redundant(fans: Fans, poses: Array, hosts: Ints, near: Mask, free: Floats) -> Mask:
    """Return whether each of the first m scans adds nothing to the n others; all are at `poses`.

    hosts (m,) are their hosts, near (m, n) the neighbours among the others, and free (m, BEARINGS) their
    free ranges; see `View`.
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
                    known[p - begin] = nearest_feature(fans, m + n, x, y, POINT_RADIUS) >= 0
        between_in_kernel(poses[k], poses[hosts[k]], T)
        vantage[0, :2] = scans.lasers[k]
        begin, end, gone = scans.starts[hosts[k]], scans.starts[hosts[k] + 1], 0
        for p in range(begin, end):
            x, y = _moved(T, scans.features[p, 0], scans.features[p, 1])
            gone += evidence_at(x, y, vantage, free[k : k + 1]) < 0
        out[k] = known.mean() >= MIN_COVERED and gone <= MAX_GONE * (end - begin)
    return out


@kernel
def _moved(T: Array, x: float, y: float) -> tuple[float, float]:
    """Return a point transformed by T (3,)."""
    c, s = math.cos(T[2]), math.sin(T[2])
    return T[0] + c * x - s * y, T[1] + s * x + c * y
