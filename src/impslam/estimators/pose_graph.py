"""The pose graph of a drive: nodes along the path, and loop closures between them.

Sessions are parts of the graph that no edge connects. Each has a frame of its own, defined by its first
node. A closure between two sessions joins them.
"""

from __future__ import annotations

import math
from copy import copy
from typing import Any

import numpy as np

from impslam.geometry.chain import advance
from impslam.geometry.covariances import inverse_of
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import (
    between,
    block_rotation,
    compose,
    compose_uncertain,
    inverse,
    inverse_uncertain,
)
from impslam.graph.edges import roots
from impslam.graph.solve import marginals, solve
from impslam.growing_array import GrowingArray
from impslam.noise import UNKNOWN
from impslam.types import Array, Edges, Ints, Mask

KERNEL = 25.0
"""Squared Mahalanobis distance beyond which the weight of a closure decreases: 5 sigma."""
CLOSURE_LENGTH = 0.5
"""m, path length of a closure: its error is that of so much driving."""
MIN_CORRECTION = 0.1, 0.01
"""m, rad: closures with smaller corrections do not trigger a solution."""


class PoseGraph:
    """Nodes with their poses, the chains of motions between them, and closures.

    The node `first` is fixed: it defines the map frame. Also fixed are the first nodes of pending sessions,
    and the first `frozen` nodes, those of a frozen map. A node close to another one can be folded into it:
    its edges are transferred to the other node, its host, and it moves with that (the reduced pose graph,
    Johannsson et al. 2013).

    Attributes
    ----------
    poses : (n, 3) `T_map_node`; in a pending session relative to its own frame
    covariances : (n, 3, 3), from the last solution and propagated from there
    hosts : (n,) the node that each is folded into; itself if it is not folded
    closures : number of closures
    first : the first node of the map; earlier ones are a session of their own, which no edge connects to it
    """

    frozen = first = 0
    _roots: Ints | None = None  # None: the edges or nodes have changed since

    def __init__(self) -> None:
        self.poses, self.covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        self.hosts, self.closures = np.empty(0, np.int64), 0
        self._T_host_node, self._host_covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        self._edges = _columns()

    def __copy__(self) -> PoseGraph:
        """Return a snapshot; the original only writes beyond the end of its arrays."""
        other = type(self).__new__(type(self))
        vars(other).update(vars(self), _edges=tuple(copy(column) for column in self._edges))
        return other

    def __len__(self) -> int:
        """Return the number of nodes, including folded ones."""
        return len(self.poses)

    @classmethod
    def from_nodes(
        cls, poses: Array, covariances: Array, hosts: Ints, edges: Edges, lengths: Array
    ) -> PoseGraph:
        """Return a graph of nodes (n, 3), their hosts (n,), and edges between those not folded.

        `lengths` (e,) m are the path lengths of the edges.
        """
        graph = cls()
        graph.poses, graph.covariances = poses, covariances
        graph.hosts, graph._T_host_node = hosts, between(poses[hosts], poses)
        graph._host_covariances = np.zeros_like(covariances)
        for column, rows in zip(graph._edges, (*edges, lengths), strict=True):
            column.append(rows, len(rows))
        graph.closures = int(np.isfinite(edges.kernel).sum())
        return graph

    def add_root(self, pose: Array, covariance: Array) -> None:
        """Add a node at a pose (3,) without an edge: the first one of a session."""
        self._roots = None
        self.hosts = np.append(self.hosts, len(self))
        for name, row in (
            ("poses", pose), ("covariances", covariance),
            ("_T_host_node", np.zeros(3)), ("_host_covariances", np.zeros((3, 3))),
        ):  # fmt: skip
            setattr(self, name, np.concatenate([getattr(self, name), row[None]]))

    def begin_map_at(self, first: int, covariance: Array) -> None:
        """Make the session that begins at node `first` the map; `covariance` (3, 3) is that of its pose.

        Raises as `solve` does.
        """
        self.first, self._roots, self.covariances = first, None, self.covariances.copy()
        self.covariances[first] = covariance
        self.solve()

    def extend(self, T: Array, covariance: Array, length: float) -> None:
        """Add a node after the motion T (3,) of covariance (3, 3) and path length `length`, m."""
        information = inverse_of(covariance)
        self.add_root(*compose_uncertain(self.poses[-1], self.covariances[-1], T, covariance))
        self._add(len(self) - 2, len(self) - 1, T, information, math.inf, length)

    def add_closure(
        self, i: int, j: int, T_i_j: Array, information: Array, length: float = CLOSURE_LENGTH
    ) -> bool:
        """Add a closure, as certain as the drift over `length` m; return whether the graph must be solved.

        `T_i_j` (3,) is the pose of node j in node i, with its `information` (3, 3).
        The first closure between two sessions moves the later one accordingly.
        """
        edge = self._between_hosts(i, j, T_i_j, information)
        joins = self._join(i, j, T_i_j)
        self.closures += 1
        self._add(*edge, KERNEL, length)
        d = between(between(self.poses[i], self.poses[j]), T_i_j)
        return joins or bool(
            math.hypot(d[0], d[1]) > MIN_CORRECTION[0] or abs(d[2]) > MIN_CORRECTION[1]
        )

    def _join(self, i: int, j: int, T_i_j: Array) -> bool:
        """Move the later session of two to satisfy an edge; return whether there are two."""
        root = self.roots
        if root[i] == root[j]:
            return False
        if root[i] > root[j]:
            i, j, T_i_j = j, i, inverse(T_i_j)
        goal, later = compose(self.poses[i], T_i_j), root == root[j]
        shift = compose(goal, inverse(self.poses[j]))
        turn = block_rotation(float(shift[2]))
        self.poses, self.covariances = self.poses.copy(), self.covariances.copy()
        self.poses[later] = compose(shift, self.poses[later])
        self.covariances[later] = turn @ self.covariances[later] @ turn.T
        return True

    def cut(self, node: int) -> tuple[Array, Array] | None:
        """Separate the nodes from one on, which then are a session of their own.

        Returns the motion (3,) to the node from the one before, and its covariance (3, 3); None if other
        edges connect the two parts, too, or if nodes have been folded across.
        """
        edges = self.edges
        crossing = np.flatnonzero(
            (np.minimum(edges.i, edges.j) < node) & (np.maximum(edges.i, edges.j) >= node)
        )
        if len(crossing) != 1 or (self.hosts[node:] < node).any():
            return None
        covariance = inverse_of(edges.information[crossing[0]])
        self.closures -= int(np.isfinite(edges.kernel[crossing[0]]))
        self._roots = None
        for column in self._edges:
            column.remove(crossing)
        return between(self.poses[node - 1], self.poses[node]), covariance

    def _add(self, *edge: Any) -> None:
        self._roots = None
        for column, value in zip(self._edges, edge, strict=True):
            column.append(value)

    @property
    def is_folded(self) -> Mask:
        """Whether each node (n,) is folded into another one."""
        return np.asarray(self.hosts != np.arange(len(self)))

    @property
    def edges(self) -> Edges:
        """All motions and closures, between nodes that are not folded."""
        return Edges(*(column.array for column in self._edges[:5]))

    def fold(self, node: int, host: int, T_host_node: Array, covariance: Array) -> None:
        """Fold a node into another one, relative to which it is at T (3,) with covariance (3, 3).

        Each edge of the node is moved to the host, with an independent error of T for each. Of several
        edges of a kind between the same nodes only the most accurate is kept: repeated measurements of one
        place have similar errors, and the number of edges must not exceed that of places.
        """
        T_host_node, covariance = compose_uncertain(
            self._T_host_node[host], self._host_covariances[host], T_host_node, covariance
        )
        host = int(self.hosts[host])
        if node in (0, self.first, host) or self.is_folded[node]:
            return
        for name, value in (
            ("hosts", host),
            ("_T_host_node", T_host_node),
            ("_host_covariances", covariance),
        ):
            column = getattr(self, name).copy()
            column[node] = value
            setattr(self, name, column)
        self._roots = None
        old, self._edges = [column.array for column in self._edges], _columns()
        moved = (old[0] == node) | (old[1] == node)
        for column, values in zip(self._edges, old, strict=True):
            column.append(values[~moved], int(np.count_nonzero(~moved)))
        for i, j, T_i_j, information, kernel2, length in zip(*(v[moved] for v in old), strict=True):
            self._merge(
                *self._between_hosts(i, j, T_i_j, information), kernel2, length + CLOSURE_LENGTH
            )

    def _between_hosts(self, i: int, j: int, T_i_j: Array, information: Array) -> tuple[Any, ...]:
        """Return an edge between the hosts of its ends."""
        if not (self.is_folded[i] or self.is_folded[j]):
            return i, j, T_i_j, information
        T_host, P_host = self._T_host_node, self._host_covariances
        edge = T_i_j, inverse_of(information + np.eye(3) / UNKNOWN)  # 0 along a corridor
        T, P = between_hosts((T_host[i], P_host[i]), edge, (T_host[j], P_host[j]))
        return self.hosts[i], self.hosts[j], T, inverse_of(P)

    def _merge(self, *edge: Any) -> None:
        """Add an edge; if there is one of its kind already, keep only the more accurate one."""
        i, j, _, information, kernel2, _ = edge
        if i == j:
            return
        begins, ends, _, known, kernels, _ = (column.array for column in self._edges)
        is_parallel = ((begins == i) & (ends == j)) | ((begins == j) & (ends == i))
        rows = np.flatnonzero(is_parallel & (kernels == kernel2))
        if not len(rows):
            self._add(*edge)
        elif np.linalg.det(known[rows[0]]) < np.linalg.det(information):
            for column, value in zip(self._edges, edge, strict=True):
                column.replace(rows[:1], np.asarray(value))

    @property
    def roots(self) -> Ints:
        """First node (n,) that is connected to each; 0 for those that are placed in the map.

        Nodes of the session before the map have the root `first`.
        """
        if self._roots is None:
            root = self._components()
            swapped = np.where(root == self.first, 0, np.where(root == 0, self.first, root))
            self._roots = np.asarray(swapped)
            self._roots.flags.writeable = False
        return self._roots

    def _components(self) -> Ints:
        """Return the first node (n,) that is connected to each."""
        i, j, *_ = self.edges
        return np.asarray(roots(len(self), i, j)[self.hosts])

    def solve(self) -> None:
        """Move the nodes to the optimum of motions and closures.

        Raises
        ------
        NumericalError
            If there is no solution; the nodes stay where they are.
        """
        root, nodes = self._components(), np.arange(len(self))
        fixed = np.flatnonzero((root == nodes) | (nodes < self.frozen) | self.is_folded)
        solution = solve(self.poses, self.edges, fixed)
        covariances = self._with_folded(
            solution.poses, marginals(solution.poses, self.edges, fixed)
        )
        covariances += self.covariances[root]
        covariances[: self.frozen] = self.covariances[: self.frozen]
        self.poses = compose(solution.poses[self.hosts], self._T_host_node)
        self.covariances = covariances

    def _with_folded(self, poses: Array, covariances: Array) -> Array:
        """Return covariances (n, 3, 3) of all nodes, given poses (n, 3) and those of nodes not folded."""
        out = covariances[self.hosts]
        _add_folded(poses, self.hosts, self._T_host_node, self._host_covariances, out)
        return out

    def reach(self, node: int) -> Array:
        """Return the uncertainty (n,) m of each node's position relative to one node, 3 sigma.

        It is infinite for nodes that no edges connect to that node. Raises as `solve` does.
        """
        apart = self.roots != self.roots[node]
        fixed = apart | self.is_folded
        fixed[self.hosts[node]] = True
        covariances = marginals(self.poses, self.edges, np.flatnonzero(fixed))
        covariances = self._with_folded(self.poses, covariances)
        variances = np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1]
        return np.where(apart, math.inf, 3.0 * np.sqrt(np.maximum(variances, 0.0)))

    def path_lengths(self, node: int) -> Array:
        """Return the length (n,) m of the shortest path from a node to each, along the edges."""
        i, j, *_, length = (column.array for column in self._edges)
        return _shortest_paths(len(self), i, j, length, int(self.hosts[node]))[self.hosts]


def _columns() -> tuple[GrowingArray, ...]:
    """Return columns for the edges: i, j, T_i_j, information, kernel, length."""
    i, j = GrowingArray(dtype=np.int64), GrowingArray(dtype=np.int64)
    return i, j, GrowingArray(3), GrowingArray(3, 3), GrowingArray(), GrowingArray()


def between_hosts(
    at_i: tuple[Array, Array], edge: tuple[Array, Array], at_j: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return an edge between the hosts of its ends, given where these are relative to the hosts.

    All are poses (..., 3) and covariances (..., 3, 3).
    """
    return compose_uncertain(*compose_uncertain(*at_i, *edge), *inverse_uncertain(*at_j))


@kernel
def _add_folded(poses: Array, hosts: Ints, T: Array, P: Array, covariances: Array) -> None:
    """Propagate covariances (n, 3, 3) of the hosts to their nodes, at T (n, 3), P (n, 3, 3) from them."""
    for n in range(len(hosts)):
        if hosts[n] != n:
            advance(poses[hosts[n]].copy(), covariances[n], T[n], P[n])


@kernel
def _shortest_paths(n: int, i: Ints, j: Ints, length: Array, start: int) -> Array:
    """Return shortest path lengths (n,) from a node by sweeps over the edges (Bellman 1958).

    The edges are in the order of the drive, so a sweep forward and one backward suffice for a chain.
    """
    distances = np.full(n, np.inf)
    distances[start] = 0.0
    changed = True
    while changed:
        changed = False
        for sweep in range(2):
            for k in range(len(i)):
                e = k if sweep == 0 else len(i) - 1 - k
                a, b = distances[i[e]], distances[j[e]]
                if a + length[e] < b:
                    distances[j[e]], changed = a + length[e], True
                elif b + length[e] < a:
                    distances[i[e]], changed = b + length[e], True
    return distances
