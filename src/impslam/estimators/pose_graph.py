"""The pose graph that grows with the drive: nodes along the way, and closures between them.

Sessions are drives whose relation is not measured: parts of the graph that no edge connects. Each lies
in a frame of its own, which its first node holds. A closure from one to another joins them.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose, compose_uncertain, inverse, rotation
from impslam.graph.pose_graph import Edges, roots
from impslam.graph.solve import marginals, solve
from impslam.growing import GrowingArray
from impslam.types import Array, Ints

KERNEL = 25.0
"""Squared Mahalanobis distance beyond which a closure counts for less and less: 5 sigma."""
CLOSURE_LENGTH = 0.5
"""m of way that a closure counts for: its own error is that of so much driving."""
SHIFT = 0.1, 0.01
"""m, rad: a closure that says less is kept, and moves nothing until the next solution."""


class PoseGraph:
    """Nodes with their poses, the chains of motions between them, and closures.

    The first node is fixed: it says where the map lies. So is the first one of each session that
    nothing connects to it, and so are the first `frozen` ones, a map that is to stay as it is.

    Attributes
    ----------
    poses : (n, 3) `T_map_node`; of a session that is not connected to the first node, in its frame
    covariances : (n, 3, 3), as of the last solution and by the chain from there
    """

    frozen = 0

    def __init__(self) -> None:
        self.poses, self.covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        self._i, self._j = GrowingArray(dtype=np.int64), GrowingArray(dtype=np.int64)
        self._T_i_j, self._information = GrowingArray(3), GrowingArray(3, 3)
        self._kernel, self._length = GrowingArray(), GrowingArray()

    def __copy__(self) -> PoseGraph:
        """Return the graph as it is now; this one only writes behind the other's end."""
        other = type(self).__new__(type(self))
        for name, value in vars(self).items():
            setattr(other, name, copy(value) if isinstance(value, GrowingArray) else value)
        return other

    def __len__(self) -> int:
        """Return the number of nodes."""
        return len(self.poses)

    @classmethod
    def of(cls, poses: Array, covariances: Array, edges: Edges, lengths: Array) -> PoseGraph:
        """Return a graph of nodes (n, 3) and edges, each of which counts for `lengths` (e,) m of way."""
        graph = cls()
        graph.poses, graph.covariances = poses, covariances
        columns = (graph._i, graph._j, graph._T_i_j, graph._information, graph._kernel)
        for column, rows in zip(columns, edges, strict=True):
            column.append(rows, len(rows))
        graph._length.append(lengths, len(lengths))
        return graph

    def begin(self, pose: Array, covariance: Array) -> None:
        """Add the first node of a session, at a pose (3,)."""
        self.poses = np.concatenate([self.poses, pose[None]])
        self.covariances = np.concatenate([self.covariances, covariance[None]])

    def go_on(self, T: Array, covariance: Array, length: float) -> None:
        """Add a node after the motion T (3,), its covariance (3, 3), along `length` m of way."""
        pose, spread = compose_uncertain(self.poses[-1], self.covariances[-1], T, covariance)
        self.poses = np.concatenate([self.poses, pose[None]])
        self.covariances = np.concatenate([self.covariances, spread[None]])
        self._add(
            len(self) - 2, len(self) - 1, T, np.asarray(np.linalg.inv(covariance)), math.inf, length
        )

    def close(self, i: int, j: int, T_i_j: Array, information: Array) -> bool:
        """Add a closure; tell whether it says anything new.

        If it is the first one between two sessions, the later one is moved to where it says.
        """
        joins = self._join(i, j, T_i_j)
        self._add(i, j, T_i_j, information, KERNEL, CLOSURE_LENGTH)
        d = between(between(self.poses[i], self.poses[j]), T_i_j)
        return joins or bool(math.hypot(d[0], d[1]) > SHIFT[0] or abs(d[2]) > SHIFT[1])

    def _join(self, i: int, j: int, T_i_j: Array) -> bool:
        """Move the later session of two to where an edge has it; tell whether there are two."""
        root = self.roots
        if root[i] == root[j]:
            return False
        if root[i] > root[j]:
            i, j, T_i_j = j, i, inverse(T_i_j)
        goal, later = compose(self.poses[i], T_i_j), root == root[j]
        shift = compose(goal, inverse(self.poses[j]))
        turn = np.eye(3)
        turn[:2, :2] = rotation(float(shift[2]))
        self.poses, self.covariances = self.poses.copy(), self.covariances.copy()
        self.poses[later] = compose(shift, self.poses[later])
        self.covariances[later] = turn @ self.covariances[later] @ turn.T
        return True

    def take_back(self, closures: int) -> None:
        """Forget the newest closures, which no motion follows."""
        for column in (
            self._i, self._j, self._T_i_j, self._information, self._kernel, self._length,
        ):  # fmt: skip
            column.shorten(closures)

    def _add(
        self, i: int, j: int, T_i_j: Array, information: Array, kernel2: float, length: float
    ) -> None:
        self._i.append(i)
        self._j.append(j)
        self._T_i_j.append(T_i_j)
        self._information.append(information)
        self._kernel.append(kernel2)
        self._length.append(length)

    @property
    def edges(self) -> Edges:
        """All motions and closures."""
        return Edges(
            self._i.array, self._j.array, self._T_i_j.array, self._information.array,
            self._kernel.array,
        )  # fmt: skip

    @property
    def closures(self) -> int:
        """Number of closures."""
        return int(np.isfinite(self._kernel.array).sum())

    @property
    def roots(self) -> Ints:
        """First node (n,) that is connected to each; 0 of those that are placed in the map."""
        return np.asarray(roots(len(self), self._i.array, self._j.array))

    def solve(self) -> None:
        """Move the nodes to where motions and closures agree best.

        Raises
        ------
        NumericalError
            If there is no solution; the nodes stay where they are.
        """
        root = self.roots
        fixed = np.flatnonzero(
            (root == np.arange(len(self))) | (np.arange(len(self)) < self.frozen)
        )
        solution = solve(self.poses, self.edges, fixed)
        covariances = marginals(solution.poses, self.edges, fixed) + self.covariances[root]
        covariances[: self.frozen] = self.covariances[: self.frozen]
        self.poses, self.covariances = solution.poses, covariances

    def ways(self, node: int) -> Array:
        """Return the shortest way (n,) m from a node to each, along motions and closures."""
        return _ways(len(self), self._i.array, self._j.array, self._length.array, node)


@kernel
def _ways(n: int, i: Ints, j: Ints, length: Array, start: int) -> Array:
    """Return the shortest ways (n,) from a node by sweeps over the edges (Bellman 1958).

    The edges are in the order of the drive, so that a sweep ahead and one back settle a chain.
    """
    ways = np.full(n, np.inf)
    ways[start] = 0.0
    changed = True
    while changed:
        changed = False
        for sweep in range(2):
            for k in range(len(i)):
                e = k if sweep == 0 else len(i) - 1 - k
                a, b = ways[i[e]], ways[j[e]]
                if a + length[e] < b:
                    ways[j[e]], changed = a + length[e], True
                elif b + length[e] < a:
                    ways[i[e]], changed = b + length[e], True
    return ways
