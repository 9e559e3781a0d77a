"""The pose graph that grows with the drive: nodes along the way, and closures between them."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose_uncertain
from impslam.graph.pose_graph import Edges
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
    """Nodes with their poses, the chain of motions between them, and closures.

    The first node is fixed: it says where the map lies.

    Attributes
    ----------
    poses : (n, 3) `T_map_node`
    covariances : (n, 3, 3), as of the last solution and by the chain from there
    """

    def __init__(self) -> None:
        self.poses, self.covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        self._i, self._j = GrowingArray(dtype=np.int64), GrowingArray(dtype=np.int64)
        self._T_i_j, self._information = GrowingArray(3), GrowingArray(3, 3)
        self._kernel, self._length = GrowingArray(), GrowingArray()

    def __len__(self) -> int:
        """Return the number of nodes."""
        return len(self.poses)

    def begin(self, pose: Array, covariance: Array) -> None:
        """Add the first node, at a pose (3,)."""
        self.poses, self.covariances = pose[None].copy(), covariance[None].copy()

    def go_on(self, T: Array, covariance: Array, length: float) -> None:
        """Add a node after the motion T (3,), its covariance (3, 3), along `length` m of way."""
        pose, spread = compose_uncertain(self.poses[-1], self.covariances[-1], T, covariance)
        self.poses = np.concatenate([self.poses, pose[None]])
        self.covariances = np.concatenate([self.covariances, spread[None]])
        self._add(
            len(self) - 2, len(self) - 1, T, np.asarray(np.linalg.inv(covariance)), math.inf, length
        )

    def close(self, i: int, j: int, T_i_j: Array, information: Array) -> bool:
        """Add a closure; tell whether it says anything new."""
        self._add(i, j, T_i_j, information, KERNEL, CLOSURE_LENGTH)
        d = between(between(self.poses[i], self.poses[j]), T_i_j)
        return bool(math.hypot(d[0], d[1]) > SHIFT[0] or abs(d[2]) > SHIFT[1])

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
        return len(self._i) - max(len(self) - 1, 0)

    def solve(self) -> None:
        """Move the nodes to where motions and closures agree best.

        Raises
        ------
        NumericalError
            If there is no solution; the nodes stay where they are.
        """
        fixed = np.zeros(1, np.int64)
        solution = solve(self.poses, self.edges, fixed)
        covariances = marginals(solution.poses, self.edges, fixed)
        self.poses, self.covariances = solution.poses, covariances + self.covariances[0]

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
