"""Published pose graphs solved here and by gtsam, and a graph as large as a building's.

    python -m benchmarks.pose_graphs ../shared/data/pose-graphs    # a table as markdown

Times are CPU times of one thread, the minimum of several runs in one process. Our solver starts from
`initial`; gtsam starts from the same poses and from odometry, with Levenberg-Marquardt to the same
accuracy. `SuperLU` solves the equations of the same graph once, with scipy's best ordering.
"""
# ruff: noqa: E402  threads are limited before numpy is imported

from __future__ import annotations

import argparse
import importlib.util
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _library in ("OPENBLAS", "MKL", "OMP", "TBB"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import numpy as np
from benchmarks.g2o import read_g2o
from benchmarks.initial_poses import initial
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from impslam.errors import NumericalError
from impslam.geometry.se2 import between, compose
from impslam.graph.block_system import empty_system
from impslam.graph.cholesky import empty_factor, factorise, substitute
from impslam.graph.edges import Costs, linearise
from impslam.graph.elimination import eliminate
from impslam.graph.solve import marginals, solve
from impslam.types import Array, Edges

RUNS = 5
FIRST = np.array([0])
HEAD = (
    "graph", "poses", "edges", "chi2 (odometry)", "chi2 (initial)",
    "gtsam (odometry)", "gtsam (initial)", "odometry ms", "initial ms", "solve ms", "gtsam ms",
    "marginals ms", "gtsam ms", "equations ms", "SuperLU ms",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("folder", type=Path, help="of .g2o files")
    given = parser.parse_args()
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    poses, edges = building(200, 40)
    report("building, 200", poses, edges)
    for path in sorted(given.folder.glob("*.g2o")):
        graph = read_g2o(path)
        report(path.stem, graph.poses, graph.edges)


def building(n: int, closures: int) -> tuple[Array, Edges]:
    """Return dead reckoning along corridors with loops, as an online graph has them."""
    rng = np.random.default_rng(0)
    truth = np.zeros((n, 3))
    for k in range(1, n):
        turn = np.pi / 2 if k % 25 == 0 else 0.0
        truth[k] = compose(truth[k - 1], np.array([1.5, 0.0, turn]))
    far = np.linalg.norm(truth[:, None, :2] - truth[None, :, :2], axis=2)
    near = np.argwhere((far < 3.0) & (np.subtract.outer(np.arange(n), np.arange(n)) > 20))
    near = near[rng.choice(len(near), closures, replace=False)]
    i, j = np.r_[np.arange(n - 1), near[:, 1]], np.r_[np.arange(1, n), near[:, 0]]
    sigmas = np.where(np.arange(len(i))[:, None] < n - 1, [0.02, 0.01, 0.005], [0.02, 0.02, 0.004])
    T_i_j = between(truth[i], truth[j]) + rng.normal(0.0, 1.0, (len(i), 3)) * sigmas
    information = np.einsum("ea,ab->eab", sigmas**-2.0, np.eye(3))
    start = truth.copy()
    for k in range(1, n):
        start[k] = compose(start[k - 1], T_i_j[k - 1])
    kernel = np.where(np.arange(len(i)) < n - 1, np.inf, 25.0)
    return start, Edges(i, j, T_i_j, information, kernel)


def report(name: str, poses: Array, edges: Edges) -> None:
    begin = initial(poses, edges, FIRST)
    best = solve(begin, edges, FIRST)
    try:
        odometry = f"{solve(poses, edges, FIRST).chi2:.4f}"
        from_odometry = f"{min_time(lambda: solve(poses, edges, FIRST)):.2f}"
    except NumericalError:
        odometry = from_odometry = "none"
    cells = [name, str(len(poses)), str(len(edges.i)), odometry, f"{best.chi2:.4f}"]
    theirs = ["", "", "", ""]
    if importlib.util.find_spec("gtsam"):
        theirs = gtsam_figures(poses, begin, edges)
    cells += theirs[:2]
    cells += [
        from_odometry,
        f"{min_time(lambda: initial(poses, edges, FIRST)):.2f}",
        f"{min_time(lambda: solve(begin, edges, FIRST)):.2f}",
        theirs[2],
        f"{min_time(lambda: marginals(best.poses, edges, FIRST)):.2f}",
        theirs[3],
        *equations(best.poses, edges),
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


def min_time(function: Callable[[], object]) -> float:
    """Return the minimum CPU time of several calls, ms."""
    times = []
    for _ in range(RUNS + 1):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return 1e3 * min(times[1:])


def equations(poses: Array, edges: Edges) -> tuple[str, str]:
    """Return the times in ms to solve the equations, with ordering: our factorisation and SuperLU."""
    n, held = len(poses), np.arange(len(poses)) == 0
    system = empty_system(edges.i, edges.j, held)
    linearise(poses, edges, 1.0, system, Costs(np.empty(len(edges.i)), np.empty(len(edges.i))))
    x = np.empty_like(poses)

    def ours() -> None:
        factor = empty_factor(eliminate(edges.i, edges.j, held))
        factorise(system, 0.0, factor)
        substitute(factor, system.gradient, x)

    everyone = np.arange(n)
    i = np.concatenate([everyone, edges.i, edges.j])
    j = np.concatenate([everyone, edges.j, edges.i])
    blocks = np.concatenate([system.diagonal, system.off, system.off.transpose(0, 2, 1)])
    rows = np.broadcast_to(3 * i[:, None, None] + np.arange(3)[:, None], blocks.shape)
    columns = np.broadcast_to(3 * j[:, None, None] + np.arange(3), blocks.shape)

    def superlu() -> Array:
        H = csc_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, 3 * n))
        factor = splu(
            H,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return np.asarray(factor.solve(system.gradient.ravel()))

    ours()
    np.testing.assert_allclose(superlu(), x.ravel(), atol=1e-6)
    return f"{min_time(ours):.2f}", f"{min_time(superlu):.2f}"


def gtsam_figures(odometry: Array, begin: Array, edges: Edges) -> list[str]:
    """Return chi-squares from odometry and from our start; ms of the latter, and of marginals."""
    import gtsam  # noqa: PLC0415

    factors = gtsam.NonlinearFactorGraph()
    tight = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*odometry[0]), tight))
    for i, j, T_i_j, W in zip(edges.i, edges.j, edges.T_i_j, edges.information, strict=True):
        c, s = np.cos(T_i_j[2]), np.sin(T_i_j[2])
        B = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # its error has the axes of j
        noise = gtsam.noiseModel.Gaussian.Information(B.T @ W @ B)
        factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*T_i_j), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setAbsoluteErrorTol(1e-6)
    parameters.setRelativeErrorTol(1e-9)

    def run(poses: Array) -> Any:
        start = gtsam.Values()
        for key, pose in enumerate(poses):
            start.insert(key, gtsam.Pose2(*pose))
        return gtsam.LevenbergMarquardtOptimizer(factors, start, parameters)

    best = run(begin).optimize()
    chi2 = [2.0 * factors.error(found) for found in (run(odometry).optimize(), best)]
    optimisers = [run(begin) for _ in range(RUNS + 1)]  # construction is not timed

    def covariances() -> None:
        known = gtsam.Marginals(factors, best)
        for key in range(len(begin)):
            known.marginalCovariance(key)

    solving, marginal = min_time(lambda: optimisers.pop().optimize()), min_time(covariances)
    return [f"{chi2[0]:.4f}", f"{chi2[1]:.4f}", f"{solving:.2f}", f"{marginal:.2f}"]


if __name__ == "__main__":
    main()
