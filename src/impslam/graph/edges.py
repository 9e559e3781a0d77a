"""Edges of a pose graph: their errors, robust weights and normal equations.

The error of an edge is T_i_j of the poses minus the measured T_i_j, additive on [x, y, theta] with theta
wrapped; poses are perturbed additively, too (Grisetti et al. 2010, Eq. 30 to 33). An edge that may be false
has a Geman-McClure kernel: a chi-square u costs c^2 u / (c^2 + u), which is u for u << c^2 and at most c^2,
and has the weight (c^2 / (c^2 + u))^2 in the normal equations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.graph.block_system import BlockSystem, add_relative, clear_system
from impslam.types import Array, Edges, Ints, Mask


class Costs(NamedTuple):
    """Chi-squares (e,) of the edges, and weights (e,) in [0, 1] by their robust kernels."""

    chi2: Array
    weights: Array


@kernel
def linearise(
    poses: Array, edges: Edges, graduation: float, system: BlockSystem, costs: Costs
) -> float:
    """Fill the normal equations and the costs of the edges between poses (n, 3); return the robust cost.

    Kernels are widened to `graduation` c^2; if it is infinite, all weights are 1.
    """
    clear_system(system)
    d, g, H, cost = np.empty(3), np.empty(3), np.empty((3, 3)), 0.0
    for e in range(len(edges.i)):
        between(poses[edges.i[e]], poses[edges.j[e]], d)
        u, share = linearise_edge(edges, e, d, graduation, H, g)
        costs.chi2[e], costs.weights[e] = u, share * share
        cost += share * u
        add_relative(system, e, poses, H, g)
    return cost


@kernel
def linearise_edge(
    edges: Edges, e: int, d: Array, graduation: float, H: Array, g: Array
) -> tuple[float, float]:
    """Fill H (3, 3) and g (3,) with the normal equations of an edge at T_i_j = d (3,).

    Returns its chi-square and the root of its weight. `graduation` is as in `linearise`.
    """
    T, W, c2 = edges.T_i_j[e], edges.information[e], graduation * edges.kernel[e]
    x, y, theta = d[0] - T[0], d[1] - T[1], wrap_in_kernel(d[2] - T[2])
    for a in range(3):
        g[a] = W[a, 0] * x + W[a, 1] * y + W[a, 2] * theta
    u = x * g[0] + y * g[1] + theta * g[2]
    share = 1.0 if c2 == math.inf else c2 / (c2 + u)
    for a in range(3):
        g[a] *= share * share
        for b in range(3):
            H[a, b] = share * share * W[a, b]
    return u, share


@kernel
def first_unconnected_pose(i: Ints, j: Ints, fixed: Mask) -> int:
    """Return the first pose that no chain of edges connects to a fixed one, or -1."""
    root = roots(len(fixed), i, j)
    is_connected = np.zeros(len(fixed), np.bool_)
    for v in range(len(fixed)):
        is_connected[root[v]] |= fixed[v]
    for v in range(len(fixed)):
        if not is_connected[root[v]]:
            return v
    return -1


@kernel
def roots(n: int, i: Ints, j: Ints) -> Ints:
    """Return for each of n poses the first one (n,) to which edges i, j (e,) connect it."""
    root = np.arange(n)
    for e in range(len(i)):
        a, b = _find(root, i[e]), _find(root, j[e])
        root[max(a, b)] = min(a, b)
    for v in range(n):
        root[v] = _find(root, v)
    return root


@kernel
def _find(root: Ints, v: int) -> int:
    while root[v] != v:
        root[v] = root[root[v]]
        v = root[v]
    return v
