"""Solve a pose graph: a pure function from poses and edges to optimal poses and their covariances.

Gauss-Newton with a Levenberg-Marquardt safeguard: a step that increases the cost is damped until it does
not. The normal equations are solved exactly with a sparse block factor. If it matters, graphs with robust
kernels are solved twice: from the given start, and graduated, from quadratic kernels down to the requested
ones (graduated non-convexity; Yang et al. 2020, with the Geman-McClure surrogate); the solution with the
lower cost is returned. A true loop that closes metres of drift is outside its kernel at the start, but not
if graduated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.errors import NumericalError
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.graph.block_system import BlockSystem, empty_system
from impslam.graph.checked import checked
from impslam.graph.cholesky import Factor, empty_factor, factorise, selected_inverse, substitute
from impslam.graph.edges import Costs, first_unconnected_pose, linearise
from impslam.graph.elimination import eliminate
from impslam.types import Array, Edges, Ints, Mask

_NARROWING = 4.0
"""Factor by which kernels narrow between two graduated descents; 1.4 (Yang et al. 2020) keeps as many true
edges and takes longer."""
_ROUGH, _FIRST_STEPS, _STEPS = 1.0, 10, 2
"""Decrease of chi-square below which a kernel is narrowed; maximum number of steps with quadratic kernels,
and with each narrower one."""
_FIRST_DAMPING, _MAX_DAMPING = 1e-7, 1e8
"""Of the diagonal: the first after a failed step, and the one at which to give up. With thousands of edges,
the diagonal is that much stiffer than the bending of a long loop."""
_ROUNDING = 1e-12
"""Relative increase of the cost that may be due to rounding."""


class Limits(NamedTuple):
    """Termination criteria.

    Attributes
    ----------
    tolerance : decrease of chi-square in the last step. At 1e-6 poses are within a thousandth of a standard
        deviation of the optimum even before that step
    iterations : maximum for each descent; graphs with good starts take 3 to 6
    graduated : whether to also try widened kernels if an edge is outside its own at the solution. Edges
        that stay rejected make each call try, 5 ms for 200 poses instead of 0.3; disable it if no edge is
        new
    """

    tolerance: float = 1e-6
    iterations: int = 100
    graduated: bool = True


class Solution(NamedTuple):
    """The solution of a pose graph.

    Attributes
    ----------
    poses : (n, 3)
    chi2 : unweighted sum of the edges' chi-squares
    cost : minimised sum of their robust costs
    weights : (e,) of the edges in [0, 1], by their robust kernels
    iterations : number of steps
    """

    poses: Array
    chi2: float
    cost: float
    weights: Array
    iterations: int


class _Problem(NamedTuple):
    edges: Edges
    system: BlockSystem
    factor: Factor
    costs: Costs


def solve(poses: Array, edges: Edges, fixed: Ints, limits: Limits | None = None) -> Solution:
    """Return the poses (n, 3) with minimum cost; those with indices `fixed` (k,) do not move.

    Raises `NumericalError` if the graph has no solution: numbers that are not finite, poses that no edges
    connect to a fixed one or with singular information, or no convergence. The arguments are not modified.
    """
    poses, edges, is_fixed = checked(poses, edges, fixed)
    solved = poses.copy()
    costs = Costs(np.zeros(len(edges.i)), np.ones(len(edges.i)))
    cost, steps, failed = _solve(solved, edges, is_fixed, limits or Limits(), costs)
    if failed != _FINE:
        raise NumericalError(_message(failed))
    return Solution(solved, float(costs.chi2.sum()), cost, costs.weights, steps)


def marginals(poses: Array, edges: Edges, fixed: Ints) -> Array:
    """Return the additive covariances (n, 3, 3) of poses (n, 3), zero for fixed ones.

    They are to first order at these poses, with edges weighted by their robust kernels. Raises as `solve`
    does.
    """
    poses, edges, is_fixed = checked(poses, edges, fixed)
    covariances, failed = _marginals(poses, edges, is_fixed)
    if failed != _FINE:
        raise NumericalError(_message(failed))
    return covariances


_FINE, _NO_CONVERGENCE, _UNCONNECTED, _SINGULAR = -1, 0, 1, 2
"""Outcomes. To the latter two, four times the pose concerned is added."""


def _message(failed: int) -> str:
    kind, pose = failed % 4, failed // 4
    if kind == _UNCONNECTED:
        return f"pose graph: no edges connect pose {pose} to a fixed one"
    if kind == _SINGULAR:
        return f"pose graph: pose {pose} is not determined; its edges' information is singular"
    return "pose graph: no convergence; the start is too far off, or edges contradict each other"


@kernel
def _prepare(edges: Edges, fixed: Mask) -> _Problem:
    i, j, e = edges.i, edges.j, len(edges.i)
    factor = empty_factor(eliminate(i, j, fixed))
    return _Problem(edges, empty_system(i, j, fixed), factor, Costs(np.empty(e), np.empty(e)))


@kernel
def _solve(
    poses: Array, edges: Edges, fixed: Mask, limits: Limits, costs: Costs
) -> tuple[float, int, int]:
    """Improve poses in place and fill their costs; return the cost, steps, and the outcome."""
    unconnected = first_unconnected_pose(edges.i, edges.j, fixed)
    if unconnected >= 0:
        return math.inf, 0, 4 * unconnected + _UNCONNECTED
    problem = _prepare(edges, fixed)
    start = poses.copy()
    cost, steps, failed = _descend(poses, 1.0, problem, limits)
    costs.chi2[:], costs.weights[:] = problem.costs.chi2, problem.costs.weights
    outside = 0.0
    for e in range(len(edges.i)):
        outside = max(outside, costs.chi2[e] / edges.kernel[e])
    if not (limits.graduated and outside > 1.0):
        return cost, steps, failed
    other, more, worse = _graduate(start, problem, limits)
    if worse == _FINE and (failed != _FINE or other < cost):
        poses[:] = start
        costs.chi2[:], costs.weights[:] = problem.costs.chi2, problem.costs.weights
        cost, failed = other, _FINE
    return cost, steps + more, failed


@kernel
def _graduate(poses: Array, problem: _Problem, limits: Limits) -> tuple[float, int, int]:
    """Descend with kernels that narrow from quadratic to the requested ones."""
    cost, steps, failed = _descend(poses, math.inf, problem, Limits(_ROUGH, _FIRST_STEPS, True))
    graduation = 1.0
    for e in range(len(problem.costs.chi2)):
        graduation = max(graduation, 2.0 * problem.costs.chi2[e] / problem.edges.kernel[e])
    while graduation > 1.0 and failed <= _NO_CONVERGENCE:
        _, more, failed = _descend(poses, graduation, problem, Limits(_ROUGH, _STEPS, True))
        steps += more
        graduation /= _NARROWING
    if failed <= _NO_CONVERGENCE:
        cost, more, failed = _descend(poses, 1.0, problem, limits)
        steps += more
    return cost, steps, failed


@kernel
def _descend(
    poses: Array, graduation: float, problem: _Problem, limits: Limits
) -> tuple[float, int, int]:
    """Improve poses in place; return the cost, steps, and the outcome.

    A step x decreases a quadratic cost by -g . x (by more if it is damped).
    """
    edges, system, factor, costs = problem
    x, trial, damping = np.empty_like(poses), poses.copy(), 0.0
    cost = linearise(poses, edges, graduation, system, costs)
    for step in range(limits.iterations):
        singular = factorise(system, damping, factor)
        if singular >= 0:
            return cost, step, 4 * singular + _SINGULAR
        substitute(factor, system.gradient, x)
        gain = (1.0 + damping) * _move(poses, x, system.gradient, trial)
        now = linearise(trial, edges, graduation, system, costs)
        if now <= cost * (1.0 + _ROUNDING):
            poses[:] = trial
            cost, damping = now, 0.1 * damping if damping > _FIRST_DAMPING else 0.0
            if gain < limits.tolerance:
                return cost, step + 1, _FINE
        else:
            cost = linearise(poses, edges, graduation, system, costs)
            if gain < limits.tolerance:
                return cost, step + 1, _FINE
            damping = max(10.0 * damping, _FIRST_DAMPING)
            if not damping < _MAX_DAMPING:
                break
    return cost, limits.iterations, _NO_CONVERGENCE


@kernel
def _move(poses: Array, x: Array, g: Array, out: Array) -> float:
    """Fill out (n, 3) with poses moved by -x; return g . x."""
    gain = 0.0
    for v in range(len(poses)):
        for a in range(3):
            out[v, a] = poses[v, a] - x[v, a]
            gain += g[v, a] * x[v, a]
        out[v, 2] = wrap_in_kernel(out[v, 2])
    return gain


@kernel
def _factorised(poses: Array, edges: Edges, fixed: Mask) -> tuple[Factor, int]:
    """Return the factor of the normal equations at poses, and the outcome."""
    problem = _prepare(edges, fixed)
    unconnected = first_unconnected_pose(edges.i, edges.j, fixed)
    if unconnected >= 0:
        return problem.factor, 4 * unconnected + _UNCONNECTED
    linearise(poses, edges, 1.0, problem.system, problem.costs)
    singular = factorise(problem.system, 0.0, problem.factor)
    return problem.factor, 4 * singular + _SINGULAR if singular >= 0 else _FINE


@kernel
def _marginals(poses: Array, edges: Edges, fixed: Mask) -> tuple[Array, int]:
    factor, failed = _factorised(poses, edges, fixed)
    if failed != _FINE:
        return np.empty((0, 3, 3)), failed
    covariances = selected_inverse(factor)[0]
    covariances[fixed] = 0.0
    return covariances, failed
