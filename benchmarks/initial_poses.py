"""Initial poses for a pose graph without good ones: headings first, then positions, both linear.

Headings are unit vectors u_i = [cos, sin] with free |u_i| (the chordal relaxation; Carlone et al. 2015,
section V): the sum of tau |u_j - R(theta_ij) u_i|^2 is quadratic. Positions at these headings are quadratic
too. Both are exact for noiseless edges. This is not robust: false edges have full weight.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.errors import NumericalError
from impslam.geometry.kernels import kernel
from impslam.graph.block_system import BlockSystem, clear_system, empty_system
from impslam.graph.checked import checked
from impslam.graph.cholesky import Factor, empty_factor, factorise, substitute
from impslam.graph.edges import first_unconnected_pose
from impslam.graph.elimination import eliminate
from impslam.types import Array, Edges, Ints, Mask


def initial(poses: Array, edges: Edges, fixed: Ints) -> Array:
    """Return initial poses (n, 3) for `solve`; of the given poses only the `fixed` (k,) are used.

    Raises `NumericalError` as `solve` does.
    """
    poses, edges, is_fixed = checked(poses, edges, fixed)
    start = poses.copy()
    failed = _initial(start, edges, is_fixed)
    if failed >= 0:
        raise NumericalError(f"pose graph: pose {failed} is not determined by edges")
    return start


@kernel
def _initial(poses: Array, edges: Edges, fixed: Mask) -> int:
    """Fill poses that are not fixed; return one that edges do not determine, or -1."""
    unconnected = first_unconnected_pose(edges.i, edges.j, fixed)
    if unconnected >= 0:
        return unconnected
    system = empty_system(edges.i, edges.j, fixed)
    factor = empty_factor(eliminate(edges.i, edges.j, fixed))
    known, x = np.zeros_like(poses), np.empty_like(poses)
    for v in np.flatnonzero(fixed):
        known[v, 0], known[v, 1] = math.cos(poses[v, 2]), math.sin(poses[v, 2])
    _sum_headings(edges, known, system)
    singular = _solve_free(system, factor, x)
    if singular >= 0:
        return singular
    for v in np.flatnonzero(~fixed):
        poses[v, 2] = math.atan2(x[v, 1], x[v, 0])
    _sum_positions(edges, poses, system)
    singular = _solve_free(system, factor, x)
    if singular >= 0:
        return singular
    for v in np.flatnonzero(~fixed):
        poses[v, 0], poses[v, 1] = x[v, 0], x[v, 1]
    return -1


@kernel
def _solve_free(system: BlockSystem, factor: Factor, x: Array) -> int:
    """Fill x (k, 3) with the solution of H x = g; return a pose that fails, or -1."""
    for v in range(len(x)):
        system.diagonal[v, 2, 2] = 1.0  # only two numbers of each block are used
    singular = factorise(system, 0.0, factor)
    substitute(factor, system.gradient, x)
    return singular


@kernel
def _sum_headings(edges: Edges, known: Array, system: BlockSystem) -> None:
    """Sum up tau |u_j - R u_i|^2; the first two columns of `known` (k, 3) are u of fixed poses."""
    clear_system(system)
    R, W = np.empty((2, 2)), np.zeros((2, 2))
    for e in range(len(edges.i)):
        c, s = math.cos(edges.T_i_j[e, 2]), math.sin(edges.T_i_j[e, 2])
        R[0, 0], R[0, 1], R[1, 0], R[1, 1] = c, -s, s, c
        W[0, 0] = W[1, 1] = edges.information[e, 2, 2]
        _add_difference(system, e, R, W, np.zeros(2), known)


@kernel
def _sum_positions(edges: Edges, poses: Array, system: BlockSystem) -> None:
    """Sum up |p_j - p_i - R(theta_i) t_ij|^2, weighted by the information of t_ij rotated to map."""
    clear_system(system)
    identity, d = np.eye(2), np.empty(2)
    for e in range(len(edges.i)):
        theta, T_i_j = poses[edges.i[e], 2], edges.T_i_j[e]
        c, s = math.cos(theta), math.sin(theta)
        d[0], d[1] = c * T_i_j[0] - s * T_i_j[1], s * T_i_j[0] + c * T_i_j[1]
        R = np.array([[c, -s], [s, c]])
        W = R @ np.ascontiguousarray(edges.information[e, :2, :2]) @ R.T
        _add_difference(system, e, identity, W, d, poses)


@kernel
def _add_difference(
    system: BlockSystem, e: int, R: Array, W: Array, d: Array, known: Array
) -> None:
    """Add |x_j - R x_i - d|^2 weighted by W (2, 2), with a rotation R; `known` are x of fixed poses."""
    i, j, fixed, V = system.i[e], system.j[e], system.fixed, W @ R
    system.off[e] = 0.0
    if not (fixed[i] or fixed[j]):
        system.off[e, :2, :2] = -V.T
    if not fixed[j]:
        system.diagonal[j, :2, :2] += W
        system.gradient[j, :2] += W @ d
        if fixed[i]:
            system.gradient[j, :2] += V @ known[i, :2]
    if not fixed[i]:
        system.diagonal[i, :2, :2] += R.T @ V
        system.gradient[i, :2] -= V.T @ d
        if fixed[j]:
            system.gradient[i, :2] += V.T @ known[j, :2]
