"""The pose graph as a pure function: from poses and edges to the best poses and their covariances.

Gauss-Newton with a Levenberg-Marquardt safeguard: a step that costs more is damped until it does not.
The normal equations are solved exactly by a sparse block factor. Edges with a
robust kernel are solved twice where it matters: from the start given, and graduated, from quadratic
kernels down to those asked for (graduated non-convexity; Yang et al. 2020, with the Geman-McClure
surrogate); the cheaper is returned. A true loop that closes metres of drift is outside its kernel
at the start; graduated, it is not.
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
from impslam.graph.elimination import eliminate
from impslam.graph.pose_graph import Costs, Edges, first_loose_pose, linearise
from impslam.types import Array, Ints, Mask

_NARROWING = 4.0
"""By what kernels narrow between two graduated descents; 1.4 (Yang et al. 2020) keeps as many true
edges and takes longer."""
_ROUGH, _FIRST_STEPS, _STEPS = 1.0, 10, 2
"""Of chi-square: a kernel narrows once a step lowers it by less; steps at most with quadratic kernels,
and with each one narrower."""
_FIRST_DAMPING, _MOST_DAMPING = 1e-7, 1e8
"""Of the diagonal: the first that is tried once a step has cost more, and the one that no step needs.
Edges in the thousand make the diagonal so much stiffer than the way that a long loop bends."""
_ROUNDING = 1e-12
"""Of the cost: what poses may seem to get worse by."""


class Limits(NamedTuple):
    """When to stop.

    Attributes
    ----------
    tolerance : of chi-square: the last step lowers it by less. At 1e-6 poses are within a thousandth of
        a standard deviation of the optimum before that step, which is taken too
    iterations : of each descent; graphs with good starts take 3 to 6
    graduated : whether robust kernels are widened first, where that may matter: if an edge is outside
        its own at the solution. Edges that stay rejected make each call try, 5 ms for 200 poses in place
        of 0.3: without it where no edge is new
    """

    tolerance: float = 1e-6
    iterations: int = 100
    graduated: bool = True


class Solution(NamedTuple):
    """A pose graph solved.

    Attributes
    ----------
    poses : (n, 3)
    chi2 : sum of the edges' chi-squares, unweighted
    cost : sum of them by their robust kernels; what was minimised
    weights : (e,) of the edges in [0, 1], by their robust kernels
    iterations : steps taken
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
    """Return the poses (n, 3) that cost least, those with indices `fixed` (k,) held where they are.

    Raises `NumericalError` if the graph has no solution: numbers that are not finite, poses that no
    edges connect to a fixed one or whose information is singular, or no convergence. What was given
    is not written to.
    """
    poses, edges, held = checked(poses, edges, fixed)
    solved = poses.copy()
    costs = Costs(np.zeros(len(edges.i)), np.ones(len(edges.i)))
    cost, steps, failed = _solve(solved, edges, held, limits or Limits(), costs)
    if failed != _FINE:
        raise NumericalError(_trouble(failed))
    return Solution(solved, float(costs.chi2.sum()), cost, costs.weights, steps)


def marginals(poses: Array, edges: Edges, fixed: Ints) -> Array:
    """Return the covariances (n, 3, 3) of poses (n, 3), additive, those of fixed ones zero.

    To first order at these poses, edges weighed by their robust kernels. Raises as `solve` does.
    """
    poses, edges, held = checked(poses, edges, fixed)
    covariances, failed = _marginals(poses, edges, held)
    if failed != _FINE:
        raise NumericalError(_trouble(failed))
    return covariances


_FINE, _UNSETTLED, _LOOSE, _SINGULAR = -1, 0, 1, 2
"""What became of a graph. The latter two are added to four times the pose they are about."""


def _trouble(failed: int) -> str:
    kind, pose = failed % 4, failed // 4
    if kind == _LOOSE:
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
    """Improve poses in place and fill in their costs; return the cost, steps, and what failed."""
    loose = first_loose_pose(edges.i, edges.j, fixed)
    if loose >= 0:
        return math.inf, 0, 4 * loose + _LOOSE
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
    """Descend with kernels that narrow from quadratic ones to those asked for."""
    cost, steps, failed = _descend(poses, math.inf, problem, Limits(_ROUGH, _FIRST_STEPS, True))
    graduation = 1.0
    for e in range(len(problem.costs.chi2)):
        graduation = max(graduation, 2.0 * problem.costs.chi2[e] / problem.edges.kernel[e])
    while graduation > 1.0 and failed <= _UNSETTLED:
        _, more, failed = _descend(poses, graduation, problem, Limits(_ROUGH, _STEPS, True))
        steps += more
        graduation /= _NARROWING
    if failed <= _UNSETTLED:
        cost, more, failed = _descend(poses, 1.0, problem, limits)
        steps += more
    return cost, steps, failed


@kernel
def _descend(
    poses: Array, graduation: float, problem: _Problem, limits: Limits
) -> tuple[float, int, int]:
    """Improve poses in place; return the cost, steps, and what failed.

    A step x lowers the cost by -g . x as far as it is quadratic (and more, if it is damped).
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
            if not damping < _MOST_DAMPING:
                break
    return cost, limits.iterations, _UNSETTLED


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
    """Return the factor of the normal equations at poses, and what failed."""
    problem = _prepare(edges, fixed)
    loose = first_loose_pose(edges.i, edges.j, fixed)
    if loose >= 0:
        return problem.factor, 4 * loose + _LOOSE
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
