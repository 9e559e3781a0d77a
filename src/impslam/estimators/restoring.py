"""Restore the keyframes and the pose graph of a map as they were in the run that made it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.errors import NumericalError
from impslam.estimators.base import MIN_SIGMA
from impslam.estimators.keyframe_log import DRIVEN_PER_RADIAN, KeyframeLog
from impslam.estimators.pose_graph import CLOSURE_LENGTH, PoseGraph
from impslam.geometry.chain import advance
from impslam.geometry.covariances import inverse_of
from impslam.geometry.se2 import between, compose, inverse, motion_lengths
from impslam.graph.edges import roots
from impslam.map import Keyframes, Map, session_starts
from impslam.maps.layout import undriven
from impslam.noise import UNKNOWN
from impslam.recognition.places import ALIGN_WINDOW
from impslam.recognition.stored_views import points_view
from impslam.types import Array, Edges, Ints

MAX_HOST_DISTANCE = 0.6
"""m between a dropped keyframe and its host; refinement has moved both by centimetres."""
MAX_FOLD_DISTANCE = 4.0
"""m between a folded node and its host, which is the node before a nearby keyframe."""


class Restored(NamedTuple):
    """The restored state; `since` is the motion from the newest node, (3,) and (3, 3)."""

    keys: KeyframeLog
    graph: PoseGraph
    since: tuple[Array, Array]


def restored(known: Map, spacing: float, *, frozen: bool = False) -> Restored:
    """Return the keyframes and the graph of a map, with nodes every `spacing` m as in the original run.

    Poses are from the solution of the graph, i.e. before the joint refinement of all keyframes, because
    motions continue from there. With `frozen` they are those of the map, and do not change. A map without
    edges has its motions from the poses, too: its tracker need not have matched scans, and its estimator
    has corrected only the poses.
    """
    rows = _usable(known.keyframes)
    if frozen or not len(known.edges.i):
        rows = replace(rows, motions=undriven(rows.poses)["motions"])
    nodes = _nodes(rows, known.edges, spacing)
    keys = _keyframe_log(rows, nodes)
    _drop(keys, rows)
    observations = known.observations or ((),) * len(rows)
    for seen, stamp in zip(observations, rows.stamps.tolist(), strict=True):
        keys.sightings.add(seen, stamp)
    i, j = np.searchsorted(nodes, known.edges.i), np.searchsorted(nodes, known.edges.j)
    edges = known.edges._replace(i=i, j=j)
    hosts = _hosts(rows, nodes, edges)
    edges = _connected(rows, nodes, hosts, edges)
    poses, covariances = rows.poses[nodes], rows.covariances[nodes]
    graph = PoseGraph.from_nodes(
        poses, covariances, hosts, edges, _lengths(edges, keys.distance[nodes])
    )
    graph.first = int(np.argmax(rows.placed[nodes]))
    if frozen:
        graph.frozen = len(nodes)
    elif len(edges.i):
        with suppress(NumericalError):  # then keep the poses of the map
            graph.solve()
    return Restored(keys, graph, _motion(rows, int(nodes[-1]), len(rows) - 1))


def _usable(rows: Keyframes) -> Keyframes:
    """Return keyframes with usable motions, as in the estimator; see `MIN_SIGMA`."""
    T, P = rows.motions, rows.motion_covariances + MIN_SIGMA**2 * np.eye(3)
    is_finite = np.asarray(np.isfinite(np.column_stack([T, P.reshape(-1, 9)])).all(axis=1))
    return replace(
        rows,
        motions=np.where(is_finite[:, None], T, 0.0),
        motion_covariances=np.where(is_finite[:, None, None], P, UNKNOWN * np.eye(3)),
    )


def _keyframe_log(rows: Keyframes, nodes: Ints) -> KeyframeLog:
    """Return the keyframes as tracked; each session starts at the pose of its first keyframe."""
    keys, first = KeyframeLog(), session_starts(rows.sessions)
    node_rows = set(nodes.tolist())
    starts = rows.starts.tolist()
    for k in range(len(rows)):
        motion, start = rows.motions[k], None
        if first[k]:
            start = compose(rows.poses[k], inverse(motion))
        points = rows.points[starts[k] : starts[k + 1]]
        seen = points_view(points, rows.origins[k]) if len(points) else None
        keys.append(motion, rows.motion_covariances[k], seen, start)
        keys.points.append(points)
        if k in node_rows and not first[k]:
            keys.mark_node()
    return keys


def _drop(keys: KeyframeLog, rows: Keyframes) -> None:
    """Restore dropped keyframes: those without points, with a nearby earlier one as host."""
    has_points = np.diff(rows.starts) > 0
    others = np.flatnonzero(has_points & rows.placed)
    dropped = []
    for k in np.flatnonzero(~has_points & rows.placed).tolist():
        earlier = others[: int(np.searchsorted(others, k))]
        if len(earlier):
            distances = np.hypot(*(rows.poses[earlier, :2] - rows.poses[k, :2]).T)
            if distances.min() < MAX_HOST_DISTANCE:
                dropped.append((k, int(earlier[np.argmin(distances)])))
    if dropped:
        at, hosts = np.array(dropped).T
        keys.drop(at, hosts, between(rows.poses[hosts], rows.poses[at]))


def _nodes(rows: Keyframes, edges: Edges, spacing: float) -> Ints:
    """Return the keyframes that are nodes: those with edges, and others `spacing` m apart."""
    steps = motion_lengths(rows.motions, DRIVEN_PER_RADIAN)
    chosen, since = session_starts(rows.sessions), 0.0
    chosen[edges.i] = chosen[edges.j] = True
    for k, step in enumerate(steps.tolist()):
        since += step
        if chosen[k] or since >= spacing:
            chosen[k], since = True, 0.0
    return np.flatnonzero(chosen)


def _hosts(rows: Keyframes, nodes: Ints, edges: Edges) -> Ints:
    """Return the node (n,) that each is folded into; itself if it is not folded.

    Nodes without an edge were folded into nearby earlier ones.
    """
    hosts, poses = np.arange(len(nodes)), rows.poses[nodes]
    tied = session_starts(rows.sessions)[nodes]
    tied[edges.i] = tied[edges.j] = True
    others, placed = np.flatnonzero(tied), rows.placed[nodes]
    for n in np.flatnonzero(~tied & placed).tolist():
        distances = np.hypot(*(poses[others, :2] - poses[n, :2]).T)
        distances[~placed[others] | (others > n)] = np.inf
        if len(edges.i) and distances.min() < MAX_FOLD_DISTANCE:
            hosts[n] = others[np.argmin(distances)]
    return hosts


def _connected(rows: Keyframes, nodes: Ints, hosts: Ints, edges: Edges) -> Edges:
    """Return the edges, plus motions where no edge connects the nodes of a session."""
    unfolded = np.flatnonzero(hosts == np.arange(len(nodes)))
    root = roots(len(nodes), edges.i, edges.j)
    motions = []
    for before, n in zip(unfolded[:-1].tolist(), unfolded[1:].tolist(), strict=True):
        if rows.sessions[nodes[before]] == rows.sessions[nodes[n]] and root[before] != root[n]:
            T, covariance = _motion(rows, int(nodes[before]), int(nodes[n]))
            motions.append((before, n, T, inverse_of(covariance), math.inf))
            root[root == root[n]] = root[before]
    if not motions:
        return edges
    more = Edges(*(np.array(column) for column in zip(*motions, strict=True)))
    return more.joined(edges)


def _lengths(edges: Edges, distance: Array) -> Array:
    """Return the path length (e,) m of each edge, given the distance driven up to each node.

    Motions of folded nodes connect their hosts, which are not consecutive. A closure without a position, as
    in a corridor, is at least as uncertain as the smallest window that is searched; see `places`.
    """
    folded = motion_lengths(edges.T_i_j, DRIVEN_PER_RADIAN)
    driven = np.where(
        edges.j == edges.i + 1, distance[edges.j] - distance[edges.i], folded + CLOSURE_LENGTH
    )
    weakest = np.linalg.eigvalsh(edges.information[:, :2, :2])[:, 0]
    closures = np.where(weakest < ALIGN_WINDOW**-2, np.inf, CLOSURE_LENGTH)
    return np.where(np.isinf(edges.kernel), driven, closures)


def _motion(rows: Keyframes, begin: int, end: int) -> tuple[Array, Array]:
    """Return the motion (3,) from one keyframe to another of its session, and its covariance."""
    T, covariance = np.zeros(3), np.zeros((3, 3))
    for k in range(begin + 1, end + 1):
        advance(T, covariance, rows.motions[k], rows.motion_covariances[k])
    return T, covariance
