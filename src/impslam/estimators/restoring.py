"""Goes on with a map: its keyframes, and the pose graph over them, as the run that made it had them."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.errors import NumericalError
from impslam.estimators.keyframe_log import TURN, KeyframeLog
from impslam.estimators.pose_graph import CLOSURE_LENGTH, PoseGraph
from impslam.geometry.chain import advance
from impslam.geometry.se2 import between, compose, inverse
from impslam.graph.pose_graph import roots
from impslam.map import Keyframes, Map
from impslam.maps.layout import undriven
from impslam.noise import UNKNOWN
from impslam.recognition.stored import points_view
from impslam.types import Array, Edges, Ints, Mask

SURE = 1e-4
"""m and rad: no motion is surer, and neither is the start; this only keeps covariances definite."""
BESIDE = 0.6
"""m: a keyframe was dropped for one that is so near; refined, both have moved by centimetres."""
FOLDED = 4.0
"""m: a node is folded into the one before a keyframe beside it, so that they are this far apart at most."""


class Restored(NamedTuple):
    """What an estimator goes on with; `since` is the motion from the newest node, (3,) and (3, 3)."""

    keys: KeyframeLog
    graph: PoseGraph
    since: tuple[Array, Array]


def restored(known: Map, spacing: float, *, frozen: bool = False) -> Restored:
    """Return the keyframes and the graph of a map, with nodes every `spacing` m as when it was made.

    Poses are those of the graph's solution, as they were before all keyframes were refined: motions go
    on from there. With `frozen` they are those of the map, which are to stay.
    """
    rows = _usable(known.keyframes)
    if frozen:
        rows = replace(rows, motions=undriven(rows.poses)["motions"])
    nodes = _nodes(rows, known.edges, spacing)
    keys = _keys(rows, nodes)
    _drop(keys, rows)
    observations = known.observations or ((),) * len(rows)
    for seen, stamp in zip(observations, rows.stamps.tolist(), strict=True):
        keys.seen.add(seen, stamp)
    i, j = np.searchsorted(nodes, known.edges.i), np.searchsorted(nodes, known.edges.j)
    edges = known.edges._replace(i=i, j=j)
    hosts = _hosts(rows, nodes, edges)
    edges = _connected(rows, nodes, hosts, edges)
    poses, covariances = rows.poses[nodes], rows.covariances[nodes]
    graph = PoseGraph.of(poses, covariances, hosts, edges, _lengths(edges, keys.way[nodes]))
    if frozen:
        graph.frozen = len(nodes)
    elif len(edges.i):
        with suppress(NumericalError):  # the poses of the map are as good
            graph.solve()
    return Restored(keys, graph, _motion(rows, int(nodes[-1]), len(rows) - 1))


def _usable(rows: Keyframes) -> Keyframes:
    """Return keyframes with motions that can be used, as the estimator takes them; see `SURE`."""
    T, P = rows.motions, rows.motion_covariances + SURE**2 * np.eye(3)
    is_known = np.asarray(np.isfinite(np.column_stack([T, P.reshape(-1, 9)])).all(axis=1))
    return replace(
        rows,
        motions=np.where(is_known[:, None], T, 0.0),
        motion_covariances=np.where(is_known[:, None, None], P, UNKNOWN * np.eye(3)),
    )


def _keys(rows: Keyframes, nodes: Ints) -> KeyframeLog:
    """Return the keyframes as tracked; each session begins at the pose of its first one."""
    keys, first = KeyframeLog(), _begins(rows.sessions)
    at = set(nodes.tolist())
    starts = rows.starts.tolist()
    for k in range(len(rows)):
        motion, start = rows.motions[k], None
        if first[k]:
            start = compose(rows.poses[k], inverse(motion))
        points = rows.points[starts[k] : starts[k + 1]]
        seen = points_view(points, rows.origins[k]) if len(points) else None
        keys.append(motion, rows.motion_covariances[k], seen, start)
        keys.points.append(points)
        if k in at and not first[k]:
            keys.mark_node()
    return keys


def _begins(sessions: Ints) -> Mask:
    return np.append(True, sessions[1:] != sessions[:-1])


def _drop(keys: KeyframeLog, rows: Keyframes) -> None:
    """Let keyframes without points go with earlier ones beside them, as those do that were dropped."""
    seeing = np.diff(rows.starts) > 0
    others = np.flatnonzero(seeing & rows.placed)
    dropped = []
    for k in np.flatnonzero(~seeing & rows.placed).tolist():
        earlier = others[: int(np.searchsorted(others, k))]
        if len(earlier):
            apart = np.hypot(*(rows.poses[earlier, :2] - rows.poses[k, :2]).T)
            if apart.min() < BESIDE:
                dropped.append((k, int(earlier[np.argmin(apart)])))
    if dropped:
        at, hosts = np.array(dropped).T
        keys.drop(at, hosts, between(rows.poses[hosts], rows.poses[at]))


def _nodes(rows: Keyframes, edges: Edges, spacing: float) -> Ints:
    """Return the keyframes that are nodes: those with edges, and others as far apart as nodes are."""
    steps = np.hypot(rows.motions[:, 0], rows.motions[:, 1]) + TURN * np.abs(rows.motions[:, 2])
    chosen, since = _begins(rows.sessions), 0.0
    chosen[edges.i] = chosen[edges.j] = True
    for k, step in enumerate(steps.tolist()):
        since += step
        if chosen[k] or since >= spacing:
            chosen[k], since = True, 0.0
    return np.flatnonzero(chosen)


def _hosts(rows: Keyframes, nodes: Ints, edges: Edges) -> Ints:
    """Return the node (n,) that each is folded into; itself if it is not.

    Nodes without an edge were folded, into earlier ones close by.
    """
    hosts, poses = np.arange(len(nodes)), rows.poses[nodes]
    tied = _begins(rows.sessions)[nodes]
    tied[edges.i] = tied[edges.j] = True
    others, placed = np.flatnonzero(tied), rows.placed[nodes]
    for n in np.flatnonzero(~tied & placed).tolist():
        apart = np.hypot(*(poses[others, :2] - poses[n, :2]).T)
        apart[~placed[others] | (others > n)] = np.inf
        if len(edges.i) and apart.min() < FOLDED:
            hosts[n] = others[np.argmin(apart)]
    return hosts


def _connected(rows: Keyframes, nodes: Ints, hosts: Ints, edges: Edges) -> Edges:
    """Return the edges between nodes, with motions along each session where none connects its nodes."""
    alone = np.flatnonzero(hosts == np.arange(len(nodes)))
    root = roots(len(nodes), edges.i, edges.j)
    motions = []
    for before, n in zip(alone[:-1].tolist(), alone[1:].tolist(), strict=True):
        if rows.sessions[nodes[before]] == rows.sessions[nodes[n]] and root[before] != root[n]:
            T, covariance = _motion(rows, int(nodes[before]), int(nodes[n]))
            motions.append((before, n, T, np.linalg.inv(covariance), math.inf))
            root[root == root[n]] = root[before]
    if not motions:
        return edges
    more = Edges(*(np.array(column) for column in zip(*motions, strict=True)))
    return more.joined(edges)


def _lengths(edges: Edges, way: Array) -> Array:
    """Return the way (e,) m that each edge counts for, with that of the nodes.

    Motions of nodes that were folded are between others, which were not driven one after the other.
    """
    folded = np.hypot(edges.T_i_j[:, 0], edges.T_i_j[:, 1]) + TURN * np.abs(edges.T_i_j[:, 2])
    driven = np.where(edges.j == edges.i + 1, way[edges.j] - way[edges.i], folded + CLOSURE_LENGTH)
    return np.where(np.isinf(edges.kernel), driven, CLOSURE_LENGTH)


def _motion(rows: Keyframes, begin: int, end: int) -> tuple[Array, Array]:
    """Return the motion (3,) from one keyframe to another of its session, and its covariance."""
    T, covariance = np.zeros(3), np.zeros((3, 3))
    for k in range(begin + 1, end + 1):
        advance(T, covariance, rows.motions[k], rows.motion_covariances[k])
    return T, covariance
